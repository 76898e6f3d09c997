"""Image quality of a lens is analysed: spot diagrams, ray fans, MTF, RMS curves and vignetting."""
