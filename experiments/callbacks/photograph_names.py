"""Names of photographs as people are shown them."""

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")


def shown_name(name: str) -> str:
    """Return a photograph's name without the suffix of its file, if it has one of an image."""
    stem, dot, suffix = name.rpartition(".")
    return stem if stem and dot + suffix.lower() in _IMAGE_SUFFIXES else name
