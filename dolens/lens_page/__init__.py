"""The page of a lens: what a designer looks at, in one HTML file or in a terminal."""

from dolens.lens_page.page import Written, is_page, write_page

__all__ = ["Written", "is_page", "write_page"]
