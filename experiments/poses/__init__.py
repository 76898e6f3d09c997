"""Poses of lenses and elements, found from images of point sources."""
