"""The search for lenses begins with a specification and ends with a set of different forms."""
