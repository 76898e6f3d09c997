"""A camera: a lens and a reconstruction network, trained together on photographs."""
