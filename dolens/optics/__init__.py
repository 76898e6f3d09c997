"""Optics of a lens: surfaces, materials, rays, tracing, first-order properties."""

# Methods that higher parts of the library give every lens: name → class that has it, as
# `dolens.views.LensViews`, which is loaded when the method is first called.
LENS_METHODS: dict[str, str] = {}
