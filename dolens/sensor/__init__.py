"""The image sensor: pixels, noise, readout, colour filters and colour encoding."""
