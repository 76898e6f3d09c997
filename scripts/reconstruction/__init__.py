"""Networks compared behind one fixed lens: the parts of scripts/reconstruction_quality.py."""
