"""The kernels trace a packed surface table fast; each backend has a folder."""
