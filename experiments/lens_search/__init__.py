"""Searches for lenses as experiments."""
