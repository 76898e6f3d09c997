"""Diffraction: wavefronts of a lens, and the point spread functions that they make."""
