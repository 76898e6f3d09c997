"""The image sensor is modelled by pixels, noise, readout, colour filters and colour encoding."""
