"""The trace, fast: packed surface tables and the kernels that run them, one backend a folder."""
