"""Each module here has the Triton functions of a phase."""
