"""The one exception that tells a user what is wrong with what they wrote."""


class InputError(ValueError):
    """Bad input from outside: a file, a key, a value.

    The message is one line that names the file, surface or key, says what was wrong
    and what is allowed.  Command-line programs print it and exit with a non-zero status.
    """
