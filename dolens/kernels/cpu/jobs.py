"""A job is an array of integers in which a driver finds its arrays and counts, at these places.

Addresses of arrays (zero: not asked for), strides in numbers, and counts.
"""

POSITION, POSITION_ROW, POSITION_COLUMN = range(3)
DIRECTION, DIRECTION_ROW, DIRECTION_COLUMN = range(3, 6)
WHICH, RAYS, STEPS, CODES, VALUES, INDICES, WAVELENGTHS, EXIT_Z, CLIP = range(6, 15)
STACK, COTANGENTS, WORK = range(15, 18)
OUT_POSITION, OUT_DIRECTION, OUT_PATH, OUT_STATUS, OUT_SURFACE, OUT_TRANSMISSION = range(18, 24)
POSITION_COTANGENT, POSITION_COTANGENT_ROW, POSITION_COTANGENT_COLUMN = range(24, 27)
DIRECTION_COTANGENT, DIRECTION_COTANGENT_ROW, DIRECTION_COTANGENT_COLUMN = range(27, 30)
PATH_COTANGENT, PATH_COTANGENT_ROW = range(30, 32)
POSITION_GRADIENT, DIRECTION_GRADIENT = range(32, 34)
SUMS, SUM_LENGTH, CHUNK, VALUES_LENGTH = range(34, 38)
LANES, INDEX_SUMS = range(38, 40)
# Of the drivers of Jacobians.
OUTPUTS, OUTPUT_ROWS, VARIABLES, FIRST_STEP = range(40, 44)
ENTRIES, ENTRY_ROWS, ENTRY_COLUMNS, ENTRY_WEIGHTS, SPLINE_COLUMNS = range(44, 49)
DRIVER_ROWS, PENDING, COTANGENT_LENGTH = range(49, 52)
OUT_VALID, OUT_VALUES, OUT_JACOBIAN = range(52, 55)
TARGET, TARGET_ROW, TARGET_COLUMN, WEIGHT, WEIGHT_ROW, GROUP, GROUPS = range(55, 62)
ENTRY_FIRST = 62
# The wavelength's column of all rays of the block at hand, plus one; zero where they differ.
WAVELENGTH = 63
# Of a renderer: arrays of integers and of numbers; see `kernels.cpu.rendering.layout`.
VIEW, LENGTHS = range(64, 66)
# Variables that indices depend on: how many; row of `indices` and column of each; and their
# derivatives, a row of wavelengths for each.
INDEX_ENTRIES, INDEX_ROWS, INDEX_COLUMNS, INDEX_WEIGHTS = range(66, 70)
# Of many lenses: the driver of one, the pieces of one, and how far the address at a place moves on
# from one lens to the next: pairs of place and bytes, and how many pairs.
INNER_DRIVER, INNER_PIECES, STRIDES, STRIDE_PAIRS = range(70, 74)
# Of losses: their numbers; where among these ratios and coefficients begin; how many series there
# are, and their terms; whether media absorb; where the sums of these numbers begin, or zero.
LOSSES, RATIOS, COEFFICIENTS, SERIES, TERMS, ABSORBS, LOSS_SUMS = range(74, 81)
TRANSMISSION_COTANGENT, TRANSMISSION_COTANGENT_ROW = range(81, 83)
LENGTH = 88  # of a job: whole lines of the cache
