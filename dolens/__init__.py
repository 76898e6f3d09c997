"""dolens: end-to-end co-design of optics and reconstruction."""
