"""Time and error of a trace, a point spread function and an image."""
