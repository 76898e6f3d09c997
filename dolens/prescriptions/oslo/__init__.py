"""OSLO lens files (`.len`, as text) are read."""
