"""Sensitivities, tolerances and yield of a lens."""
