"""The forms of a search for lenses become cameras, each learned with its network."""
