"""The images that a camera takes of a texture: at depths, in windows of a field, of layers."""
