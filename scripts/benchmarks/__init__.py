"""Parts of `scripts/benchmark.py`: what is measured, one kind a file."""
