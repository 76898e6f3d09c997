"""What a sensor sees: pupil and pixel sampling, point spread functions, renderers, the sensor."""
