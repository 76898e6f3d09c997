"""Parts of the independent check of a lens search: problem, tracers, baselines; see `compare.py`."""
