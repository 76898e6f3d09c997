"""Where numbers lie in memory: in rows of a block of rays, and in a step's record and codes.

A block's rows hold 128 numbers, one for each ray.  A row's name is the place of its first number,
so that ray i of row X is number `X + i`.  Numba takes integers of a module, and no attributes of a
class.  It freezes them when it compiles: LLVM sees constant distances between rows, without which
it would not vectorise.  `compiler.stamp` covers these sources, so that a change here makes the
kernels on disk stale.
"""

from dolens.kernels.table import Code, Failure, Kind, Outline, Slot

BLOCK = 128  # rays a block
UNBOUNDED = 1 << 40  # the length of an array that its user keeps track of


def _rows(first: int, count: int) -> tuple[int, ...]:
    """Return the places of `count` rows that follow each other, from row `first`."""
    return tuple(BLOCK * row for row in range(first, first + count))


# A state: position (mm), direction cosines, optical path (mm); 4·surface + status of the first miss
# or total reflection, and of the first aperture that stopped the ray, else zero; and the distance
# travelled to get here (mm).
X, Y, Z, L, M, N, PATH, ENDED, VIGNETTED, TRAVELLED = _rows(0, 10)
STATE = 10 * BLOCK

# Work rows that a driver fills before each step: the index in front, the ratio μ of the index in
# front to the one behind, and one over the index in front.
INDEX, RATIO = _rows(0, 2)
(INVERSE_INDEX,) = _rows(16, 1)
# Where a shape evaluates its sag, and what it gives there: sag (mm), slopes, a margin that is
# positive on the branch of the sag, and the sag's Hessian (1/mm).
POINT_X, POINT_Y, SAG, SLOPE_X, SLOPE_Y, MARGIN, SAG_XX, SAG_XY, SAG_YY = _rows(2, 9)
# Cotangents of sag and slopes; the axial distance from the vertex plane (mm).
OF_SAG, OF_SLOPE_X, OF_SLOPE_Y, DISTANCE = _rows(11, 4)
# Its first number is zero when a ray comes to the surface, and one when a spline's stencil is here.
(STENCIL_IS_HERE,) = _rows(17, 1)
# Of a deflection: λ/2π (mm); the phase (radians), its gradient and second derivatives at the
# points; cotangents of phase and gradient.
(PER_RADIAN,) = _rows(18, 1)
PHASE, PHASE_X, PHASE_Y, PHASE_XX, PHASE_XY, PHASE_YY = _rows(19, 6)
OF_PHASE, OF_PHASE_X, OF_PHASE_Y = _rows(25, 3)
# Cotangents of the cosines d·N in front of and behind a surface that loses light.
OF_ARRIVING, OF_LEAVING = _rows(28, 2)
WORK_ROWS = 30  # those above
WORK_SIZE = WORK_ROWS * BLOCK
# As many more as a shape asks for: a grid's cells, a spline's stencil.
(FURTHER,) = _rows(WORK_ROWS, 1)

# Cotangents: X to PATH as in a state, then those of the indices in front and behind.
OF_FRONT, OF_BEHIND = _rows(7, 2)
# Then a row for each number of the step's record.  By name: those of the shift, of the step and the
# turn of a change of axes, and of the first two numbers of a shape.
COTANGENT_HEADER = 16  # rows before them
(OF_RECORD,) = _rows(COTANGENT_HEADER, 1)
(OF_SHIFT,) = _rows(COTANGENT_HEADER + Slot.SHIFT, 1)
OF_STEP_X, OF_STEP_Y, OF_STEP_Z = _rows(COTANGENT_HEADER + Slot.STEP, 3)
OF_TURN_XX, OF_TURN_XY, OF_TURN_XZ = _rows(COTANGENT_HEADER + Slot.TURN, 3)
OF_TURN_YX, OF_TURN_YY, OF_TURN_YZ = _rows(COTANGENT_HEADER + Slot.TURN + 3, 3)
OF_TURN_ZX, OF_TURN_ZY, OF_TURN_ZZ = _rows(COTANGENT_HEADER + Slot.TURN + 6, 3)
OF_SHAPE, OF_SECOND = _rows(COTANGENT_HEADER + Slot.HEADER, 2)
# A ray has 16 coefficients of a spline, wherever they are; then comes the place of the first.
STENCIL_NUMBERS = 17
(STENCIL_PLACE,) = _rows(COTANGENT_HEADER + Slot.HEADER + 16, 1)

# A driver's own rows, where light is lost: the optical depth of the media; cotangents of the share
# that surfaces pass, of the depth and of the path; the argument of a series, and its sums.
DEPTH, OF_SHARE, OF_DEPTH, OF_PATH, ARGUMENT = _rows(0, 5)
SUM, BEFORE_SUM, WEIGHT = _rows(5, 3)
# Then of each series: the cosine at its surface, the share of the light that arrives there, the
# share of this that goes on, and its derivative.
LOSS_ROWS = 8
COSINES, SHARES, FACTORS, SLOPES = _rows(LOSS_ROWS, 4)
ROWS_OF_A_SERIES = 4

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
# Behind c, k and a2: the even coefficients, and what other shapes add.
BEHIND_ASPHERE = SHAPE + 3
SHORT_RECORD = 32  # as many numbers as any kernel reads by name

KIND, OFFSET, LENGTH = Code.KIND, Code.OFFSET, Code.LENGTH
BEFORE, AFTER, REFRACTS = Code.BEFORE, Code.AFTER, Code.REFRACTS
OUTLINE, HOLE = Code.EDGE, Code.HOLE
COUNT, COLUMNS, DEGREE = Code.COUNT, Code.COLUMNS, Code.DEGREE
WAVE, NUMBERS, FIGURES = Code.WAVE, Code.NUMBERS, Code.FIGURES
# The CPU's rows go on with addresses, of the step's compiled functions.
FORWARD, ADJOINT, SAG_AND_SLOPES, SAG_HESSIAN, PARAMETERS = range(Code.ROW, Code.ROW + 5)
# Whether a surface given by its sag is met from its conic, and whether it has a stencil.
STARTS_ON_CONIC, STENCIL = Code.ROW + 5, Code.ROW + 6
# Block functions of a phase.
PHASE_AND_SLOPES, PHASE_HESSIAN, PHASE_PARAMETERS = range(Code.ROW + 7, Code.ROW + 10)
# Those of the even asphere that other shapes add to.
ASPHERE_SAG, ASPHERE_HESSIAN, ASPHERE_PARAMETERS = range(Code.ROW + 10, Code.ROW + 13)
# A row of `LossTable.steps`: its series plus one, or zero; and the rest.
LOSS, COSINE, SUMMED, NEAR = range(Code.ROW + 13, Code.ROW + 17)
CODE_ROW = Code.ROW + 17

CHANGE_AXES, LENS_AXES = int(Kind.CHANGE_AXES), int(Kind.LENS_AXES)
DEFLECT, SPHERE, CONIC = int(Kind.DEFLECT), int(Kind.SPHERE), int(Kind.CONIC)
CIRCLE, RECTANGLE, ELLIPSE = int(Outline.CIRCLE), int(Outline.RECTANGLE), int(Outline.ELLIPSE)

STATUS_BITS, STATUS_MASK = Failure.BITS, Failure.MASK
STOPPED, TOTALLY_REFLECTED, MISSED = Failure.VIGNETTED, Failure.TOTALLY_REFLECTED, Failure.MISSED
