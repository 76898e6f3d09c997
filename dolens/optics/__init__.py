"""What light does: surfaces, materials, rays, tracing, first-order optics."""
