"""Renderers: images of a scene through a lens, by rays and by point spread functions."""
