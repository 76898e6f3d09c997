"""These plain integers are places in a step's record and in its row of codes.

Numba takes integers of a module, and no attributes of a class.
"""

from dolens.kernels.table import Code, Failure, Kind, Outline, Slot

SHIFT, LIMIT, SCALE = Slot.SHIFT, Slot.LIMIT, Slot.SCALE
EDGE, HALF_X, HALF_Y = Slot.EDGE, Slot.HALF_X, Slot.HALF_Y
HOLE_X, HOLE_Y = Slot.HOLE_X, Slot.HOLE_Y
CENTER_X, CENTER_Y = Slot.CENTER_X, Slot.CENTER_Y
SENSE, SENSE_BEHIND, TAG = Slot.SENSE, Slot.SENSE_BEHIND, Slot.TAG
STEP_X, STEP_Y, STEP_Z = range(Slot.STEP, Slot.STEP + 3)
TURN_XX, TURN_XY, TURN_XZ, TURN_YX, TURN_YY, TURN_YZ, TURN_ZX, TURN_ZY, TURN_ZZ = range(
    Slot.TURN, Slot.TURN + 9
)
POSE = 12  # numbers of a change of axes: its step and its turn
SHAPE = Slot.HEADER  # the first number of a shape
SHORT_RECORD = 32  # as many numbers as any kernel reads by name

KIND, OFFSET, LENGTH = Code.KIND, Code.OFFSET, Code.LENGTH
BEFORE, AFTER, REFRACTS = Code.BEFORE, Code.AFTER, Code.REFRACTS
OUTLINE, HOLE = Code.EDGE, Code.HOLE
COUNT, COLUMNS, DEGREE = Code.COUNT, Code.COLUMNS, Code.DEGREE
WAVE, NUMBERS, FIGURES = Code.WAVE, Code.NUMBERS, Code.FIGURES
# The CPU's rows go on with addresses: of the step's compiled functions, and of its extras.
FORWARD, ADJOINT, SAG_AND_SLOPES, SAG_HESSIAN, PARAMETERS, EXTRAS_ADDRESS = range(
    Code.ROW, Code.ROW + 6
)
# Whether a surface given by its sag is met from its conic, and whether it has a stencil.
STARTS_ON_CONIC, STENCIL = Code.ROW + 6, Code.ROW + 7
# Block functions of a phase.
PHASE_AND_SLOPES, PHASE_HESSIAN, PHASE_PARAMETERS = range(Code.ROW + 8, Code.ROW + 11)
CODE_ROW = Code.ROW + 11

CHANGE_AXES, LENS_AXES = int(Kind.CHANGE_AXES), int(Kind.LENS_AXES)
CIRCLE, RECTANGLE, ELLIPSE = int(Outline.CIRCLE), int(Outline.RECTANGLE), int(Outline.ELLIPSE)

STATUS_BITS, STATUS_MASK = Failure.BITS, Failure.MASK
STOPPED, TOTALLY_REFLECTED, MISSED = Failure.VIGNETTED, Failure.TOTALLY_REFLECTED, Failure.MISSED
