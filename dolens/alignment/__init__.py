"""This package finds where a lens is from what a sensor saw: models, losses, and Cramér–Rao
bounds.
"""
