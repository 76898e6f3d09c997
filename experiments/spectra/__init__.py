"""Cameras that take a spectrum at every pixel, in one exposure."""
