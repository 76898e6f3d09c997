"""Data modules: photographs in linear light, cut into crops that can be made again."""
