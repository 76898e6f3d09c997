"""The command `dolens`: one file for each of its commands."""
