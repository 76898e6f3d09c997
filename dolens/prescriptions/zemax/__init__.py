"""Zemax lens files (`.zmx`) are read and written."""
