"""Kills and faults, done to experiments that take seconds: see scripts/torture.py."""
