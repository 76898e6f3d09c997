"""Triton compiles the GPU kernels: one program carries a block of rays through all steps."""
