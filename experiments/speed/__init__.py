"""How long a trace, a point spread function or an image takes, and how wrong it is."""
