"""The gain of wavefront coding: the parts of scripts/coding_gain.py."""
