"""Designs of others are read, checked and redesigned: the parts of scripts/designs_of_others.py."""
