"""Optiland's search of a task in plain numbers: the parts of scripts/search_by_others.py."""
