"""The reference and the kernels hold a phase's deflection within the same limits."""

# An order that would turn light by more than this sine, |g_x| + |g_y|, is evanescent.
STEEPEST = 1e6
# |a·N| ≤ n/n' + |g| is below this: it holds rays in range whose directions are no unit vectors.
LONGEST = 2.0 * STEEPEST
