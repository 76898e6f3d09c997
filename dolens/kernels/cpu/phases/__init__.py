"""Each module here has the block functions of a phase."""
