"""Loggers of a run: curves, pictures, and a summary by which runs are compared."""
