"""Scenes in front of the lens: textured planes and stacks of layers."""
