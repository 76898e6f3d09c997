"""Runs that are killed, or lack what they need: the parts of scripts/fault_injection.py."""
