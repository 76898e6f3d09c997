"""A restorer is trained once for all lenses."""
