"""Parts of the independent check of a lens search: see `compare.py` and `retrace.py`."""
