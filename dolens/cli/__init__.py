"""The command `dolens` and its commands."""
