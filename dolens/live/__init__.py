"""Pages that this machine serves to its own browser: sliders for a lens, and runs as they go."""
