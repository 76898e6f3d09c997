"""The progress of a run: in a terminal, in a notebook, or as lines of the log."""
