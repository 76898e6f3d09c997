"""Searches for lenses, and for cameras made of their forms, as experiments."""
