"""Callbacks: figures and files of a run, and a notice when it is interrupted."""
