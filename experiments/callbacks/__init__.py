"""Callbacks: pictures while training, and what to do when a run is interrupted."""
