"""Where a renderer's driver finds its numbers, and the rows of its scratch memory.

Scratch, at `Job.COLUMNS`, rows of 128 as in `kernels.cpu.layout`:
    0, 1 row and column of the pixels; 2 weights of the samples; 3 one where a ray arrives at the
    plane, else zero; 4, 5 fractions between texels, along rows and columns; 6 distance to the
    plane, 7 one over the cosine there; 8, 9 texels a mm of the plane, zero beyond the texture;
    10, 11, 12 cotangents of row, column and weight;
    16 and on: a row for every image, depth and channel, in this order: the pixels themselves.
"""

SCRATCH_ROWS = 16  # before the pixels' own


class Place:
    """Places in the array of integers at `Job.VIEW`: counts, and addresses (zero: not needed)."""

    WIDTH, SIDE, PIXEL_AREA, SEED_LOW, SEED_HIGH, PIXELS = range(6)
    IMAGES, DEPTHS, CHANNELS, TEXTURE_HEIGHT, TEXTURE_WIDTH = range(6, 11)
    # Blocks: first pixel and number of pixels; groups: the first block of each, and the end.
    BLOCKS, GROUPS, TEXTURES, IMAGE, TEXTURE_SUMS, OF_LENS = range(12, 18)
    LENGTH = 24


class Length:
    """Places in the array of numbers at `Job.LENGTHS`."""

    # Pixel pitch, mm; the axis's row and column in the image; z and radius of the pupil; z of the
    # sensor; the weight of a ray along the axis.
    PITCH, MIDDLE_ROW, MIDDLE_COLUMN, PUPIL_Z, RADIUS, SENSOR_Z, WEIGHT = range(7)
    # The axis's row and column in the texture; its last ones; what image cotangents are scaled by.
    TEXTURE_ROW, TEXTURE_COLUMN, LAST_ROW, LAST_COLUMN, SCALE = range(7, 12)
    PLANES = 16  # then for every plane: its depth, mm, and texels a mm
