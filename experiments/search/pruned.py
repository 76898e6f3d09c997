"""The end of a run that its search has given up."""


class TrialPruned(Exception):
    """A run is hopeless beside the others of its search; it is stopped, and has not failed.

    The message is one line that gives the number that decided.
    """
