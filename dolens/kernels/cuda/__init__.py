"""The trace on a GPU, in Triton: one program carries a block of rays through all steps."""
