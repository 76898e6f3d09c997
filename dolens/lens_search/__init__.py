"""This package finds lenses from a specification, and tells which of them are different forms."""
