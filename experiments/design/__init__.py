"""Classical lens design: variables, a merit function and an optimizer."""
