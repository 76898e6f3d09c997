"""Co-designs on which optimizers of a lens are compared: the parts of scripts/co_designs.py."""
