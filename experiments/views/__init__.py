"""How a camera looks at textures while it is trained and judged: at depths, or over its field."""
