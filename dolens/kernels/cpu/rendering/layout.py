"""A renderer's driver finds its numbers at these places, and its scratch memory in these rows."""

from dolens.kernels.cpu.layout import BLOCK

# Places in the array of integers at `jobs.VIEW`: counts, and addresses (zero: not needed).
WIDTH, SIDE, PIXEL_AREA, SEED_LOW, SEED_HIGH, PIXELS = range(6)
IMAGES, DEPTHS, CHANNELS, TEXTURE_HEIGHT, TEXTURE_WIDTH = range(6, 11)
# Blocks: first pixel and number of pixels; groups: the first block of each, and the end.
BLOCKS, GROUPS, TEXTURES, IMAGE, TEXTURE_SUMS, OF_LENS = range(12, 18)
VIEW_LENGTH = 24

# Places in the array of numbers at `jobs.LENGTHS`: pixel pitch, mm; the axis's row and column in
# the image; z and radius of the pupil; z of the sensor; the weight of a ray along the axis.
PITCH, MIDDLE_ROW, MIDDLE_COLUMN, PUPIL_Z, RADIUS, SENSOR_Z, WEIGHT = range(7)
# The axis's row and column in the texture; its last ones; what image cotangents are scaled by.
TEXTURE_ROW, TEXTURE_COLUMN, LAST_ROW, LAST_COLUMN, SCALE = range(7, 12)
# Then for every plane two: its depth, mm, and texels a mm.
PLANES = 16

# Rows of the scratch memory at `jobs.DRIVER_ROWS`, as in `kernels.cpu.layout`: row and column of
# the pixels, and weights of the samples;
PIXEL_ROW, PIXEL_COLUMN, SAMPLE_WEIGHT = (BLOCK * row for row in range(3))
# one where a ray arrives at the plane, else zero; fractions between texels, down and across;
ARRIVES, DOWN, ACROSS = (BLOCK * row for row in range(3, 6))
# distance to the plane, and one over the cosine there; texels a mm of the plane, zero beyond the
# texture;
PLANE_DISTANCE, PER_COSINE, ROWS_PER_MM, COLUMNS_PER_MM = (BLOCK * row for row in range(6, 10))
# and the cotangents of row, column and weight.
OF_ROW, OF_COLUMN, OF_WEIGHT = (BLOCK * row for row in range(10, 13))
# Then a row for every image, depth and channel, in this order: the pixels themselves.
SCRATCH_ROWS = 16  # before them
PIXEL_SUMS = SCRATCH_ROWS * BLOCK

# Places in a group's sums, from their end: cotangents of the sensor's z, of the pupil's z and
# radius, of the weight along the axis, and of each plane's magnification.
OF_SENSOR_Z, OF_PUPIL_Z, OF_RADIUS, OF_AXIAL_WEIGHT, OF_MAGNIFICATION = range(1, 6)
