"""Runs side by side: what tells them apart, what they reached, and which of them failed."""
