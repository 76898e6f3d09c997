"""Lenses are found from a specification."""
