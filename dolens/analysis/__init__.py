"""What a lens designer looks at: spot diagrams, ray fans, modulation transfer, RMS curves."""
