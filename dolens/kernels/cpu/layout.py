"""Where the numbers of a block lie: rows of 128, one for each of a block's rays.

Kernels write row offsets as literals, 128·row: LLVM must see constant distances to vectorise
without testing for overlap.

State (10 rows): x, y, z, l, m, n; 6 path; 7 ended; 8 vignetted; 9 distance travelled to get here.
`ended` and `vignetted` hold 4·surface + status of the first failure of their kind, else zero.

Work: 0 index in front, 1 index ratio μ, then scratch:
    2 x, 3 y, 4 sag, 5 s_x, 6 s_y, 7 margin of the sag branch, 8 s_xx, 9 s_xy, 10 s_yy;
    11, 12, 13 cotangents of sag, s_x and s_y; 14, 15 the axial distance t and its start;
    16 to 23: a shape's own; 24 one over the index in front; 25 zero when a ray comes to the
    surface; 26 the coefficients of a cubic; 48 and on: a polynomial's powers, a spline's stencil.

Cotangents: 0 to 6 as in the state; 7 of the index in front, 8 of the index behind;
    16 + j: of the record's number j.  A spline's local stencil: 40 to 55, its first place in 56.
"""

BLOCK = 128
STATE = 10 * BLOCK
WORK_ROWS = 48  # before the powers of a polynomial or the stencil of a spline
STENCIL_ROWS = 30
COTANGENT_HEADER = 16

# A step's codes as the CPU kernels take them: `table.Code`, then addresses.
FORWARD, ADJOINT, SAG, BEND, PARAMETERS, EXTRAS_ADDRESS = range(16, 22)
CODES = 24


class Job:
    """Where a driver finds things: places in its array of integers.

    Addresses of arrays (zero: not asked for), strides in numbers, and counts.
    """

    POSITION, POSITION_ROW, POSITION_COLUMN = 0, 1, 2
    DIRECTION, DIRECTION_ROW, DIRECTION_COLUMN = 3, 4, 5
    WHICH, RAYS, STEPS, CODES, VALUES, INDICES, WAVELENGTHS, EXIT_Z, CLIP = range(6, 15)
    STACK, COTANGENTS, WORK = range(15, 18)
    OUT_POSITION, OUT_DIRECTION, OUT_PATH, OUT_STATUS, OUT_SURFACE = range(18, 23)
    POSITION_COTANGENT, POSITION_COTANGENT_ROW, POSITION_COTANGENT_COLUMN = range(24, 27)
    DIRECTION_COTANGENT, DIRECTION_COTANGENT_ROW, DIRECTION_COTANGENT_COLUMN = range(27, 30)
    PATH_COTANGENT, PATH_COTANGENT_ROW = range(30, 32)
    POSITION_GRADIENT, DIRECTION_GRADIENT = range(32, 34)
    SUMS, SUM_LENGTH, CHUNK, VALUES_LENGTH = range(34, 38)
    LANES, INDEX_SUMS = 38, 39
    # Of the drivers of Jacobians.
    OUTPUTS, OUTPUT_ROWS, VARIABLES, FIRST_STEP = range(40, 44)
    ENTRIES, ENTRY_ROWS, ENTRY_COLUMNS, ENTRY_WEIGHTS, SPLINE_COLUMNS = range(44, 49)
    COLUMNS, PENDING, COTANGENT_LENGTH = range(49, 52)
    OUT_VALID, OUT_VALUES, OUT_JACOBIAN = range(52, 55)
    TARGET, TARGET_ROW, TARGET_COLUMN, WEIGHT, WEIGHT_ROW, GROUP, GROUPS = range(55, 62)
    ENTRY_FIRST = 62
    # Of all rays of the block at hand, plus one; zero where they differ.
    WAVELENGTH = 63
    LENGTH = 64
