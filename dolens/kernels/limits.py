"""The reference and the kernels hold rays within the same limits."""

# Smallest cosine that is divided by, and its square, which is far above the smallest float32.
GRAZING, TINY = 1e-9, 1e-18
# mm; nothing that can be seen is farther away.
FARTHEST = 1e30
# No unit vector has a larger component; directions behind a surface are held there too.
LONGEST = 2.0
# An order that would turn light by more than this sine, |g_x| + |g_y|, is evanescent.
STEEPEST = 1e6
# |a·N| ≤ n/n' + |g| is below this: it holds rays in range whose directions are no unit vectors.
LONGEST_WAVEVECTOR = 2.0 * STEEPEST
