"""These constants of Triton are places in records and rows of codes (`dolens.kernels.table`)."""

import triton.language as tl

from dolens.kernels.table import (
    LAST_STEPS,
    NEWTON_STEPS,
    Code,
    Failure,
    Figure,
    Kind,
    Outline,
    Slot,
)

SHIFT = tl.constexpr(int(Slot.SHIFT))
STEP_X, STEP_Y, STEP_Z = (tl.constexpr(Slot.STEP + k) for k in range(3))
TURN_XX, TURN_XY, TURN_XZ = (tl.constexpr(Slot.TURN + k) for k in range(3))
TURN_YX, TURN_YY, TURN_YZ = (tl.constexpr(Slot.TURN + k) for k in range(3, 6))
TURN_ZX, TURN_ZY, TURN_ZZ = (tl.constexpr(Slot.TURN + k) for k in range(6, 9))
LIMIT = tl.constexpr(int(Slot.LIMIT))
SCALE = tl.constexpr(int(Slot.SCALE))
EDGE = tl.constexpr(int(Slot.EDGE))
HALF_X = tl.constexpr(int(Slot.HALF_X))
HALF_Y = tl.constexpr(int(Slot.HALF_Y))
HOLE_X = tl.constexpr(int(Slot.HOLE_X))
HOLE_Y = tl.constexpr(int(Slot.HOLE_Y))
CENTER_X = tl.constexpr(int(Slot.CENTER_X))
CENTER_Y = tl.constexpr(int(Slot.CENTER_Y))
SENSE = tl.constexpr(int(Slot.SENSE))
SENSE_BEHIND = tl.constexpr(int(Slot.SENSE_BEHIND))
TAG = tl.constexpr(int(Slot.TAG))
SHAPE = tl.constexpr(int(Slot.HEADER))  # the first number of a shape

KIND = tl.constexpr(int(Code.KIND))
OFFSET = tl.constexpr(int(Code.OFFSET))
BEFORE = tl.constexpr(int(Code.BEFORE))
AFTER = tl.constexpr(int(Code.AFTER))
REFRACTS = tl.constexpr(int(Code.REFRACTS))
OUTLINE = tl.constexpr(int(Code.EDGE))
HOLE = tl.constexpr(int(Code.HOLE))
COUNT = tl.constexpr(int(Code.COUNT))
COLUMNS = tl.constexpr(int(Code.COLUMNS))
EXTRAS = tl.constexpr(int(Code.EXTRAS))
DEGREE = tl.constexpr(int(Code.DEGREE))
LAW = tl.constexpr(int(Code.LAW))
BASE = tl.constexpr(int(Code.BASE))
NUMBERS = tl.constexpr(int(Code.NUMBERS))
FIGURES = tl.constexpr(int(Code.FIGURES))
LAW_EXTRAS = tl.constexpr(int(Code.LAW_EXTRAS))
ROW = tl.constexpr(int(Code.ROW))

PLANE = tl.constexpr(int(Kind.PLANE))
SPHERE = tl.constexpr(int(Kind.SPHERE))
CONIC = tl.constexpr(int(Kind.CONIC))
CHANGE_AXES = tl.constexpr(int(Kind.CHANGE_AXES))
LENS_AXES = tl.constexpr(int(Kind.LENS_AXES))
SENSOR = tl.constexpr(int(Kind.SENSOR))
DEFLECT = tl.constexpr(int(Kind.DEFLECT))

# Bits of `KINDS`, the kinds of step that a lens has: a kernel is compiled for those.
HAS_SPHERE = tl.constexpr(1 << int(Kind.SPHERE))
HAS_CONIC = tl.constexpr(1 << int(Kind.CONIC))
HAS_CHANGE_AXES = tl.constexpr(1 << int(Kind.CHANGE_AXES))
HAS_LENS_AXES = tl.constexpr(1 << int(Kind.LENS_AXES))
HAS_SENSOR = tl.constexpr(1 << int(Kind.SENSOR))
HAS_DEFLECT = tl.constexpr(1 << int(Kind.DEFLECT))
# And a bit for apertures made of figures.
WITH_FIGURES = 1 << int(Kind.BY_SAG)
HAS_FIGURES = tl.constexpr(WITH_FIGURES)

CIRCLE = tl.constexpr(int(Outline.CIRCLE))
RECTANGLE = tl.constexpr(int(Outline.RECTANGLE))
ELLIPSE = tl.constexpr(int(Outline.ELLIPSE))
ELLIPTIC, ARM = tl.constexpr(int(Figure.ELLIPTIC)), tl.constexpr(int(Figure.ARM))

# Added to a surface's tag where a ray fails; `dolens.optics.rays.Status`.
VIGNETTED = tl.constexpr(int(Failure.VIGNETTED))
TOTALLY_REFLECTED = tl.constexpr(int(Failure.TOTALLY_REFLECTED))
MISSED = tl.constexpr(int(Failure.MISSED))
STATUS_BITS, STATUS_MASK = tl.constexpr(Failure.BITS), tl.constexpr(Failure.MASK)

MAX_STEPS, MORE_STEPS = tl.constexpr(NEWTON_STEPS), tl.constexpr(LAST_STEPS)

# Rows of a block that the adjoint keeps behind every step: the ray, and the distance there.
X, Y, Z, L, M, N, TRAVELLED = (tl.constexpr(row) for row in range(7))
STATE = tl.constexpr(7)  # rows
