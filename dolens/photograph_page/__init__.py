"""Photographs on a page, compared by a slider and a magnifier."""
