"""What things cost and how wrong they are, measured side by side."""
