"""The exit pupil: its disc, the edges of the light in it, and how they move with the lens."""
