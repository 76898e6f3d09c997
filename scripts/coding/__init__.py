"""Where wavefront coding wins: the parts of scripts/coding_gain.py."""
