"""Where a lens is, from what a sensor saw: models, losses, and how well it can be known."""
