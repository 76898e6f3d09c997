"""Optics of a lens: surfaces, materials, rays, tracing, first-order properties."""
