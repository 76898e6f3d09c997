"""The one exception that tells a user what is wrong with what they wrote, and checks that raise it.

Every name that a user may misspell goes through `check_keys` or `check_choice`, so that each such
message has the same form and offers the nearest allowed name.
"""

import difflib
import re
from collections.abc import Iterable
from typing import Any

# Letters of a message, and of a word that is worth comparing with others.
_LONGEST = 500
_LONGEST_WORD = 100
# Of a longer message, so much is kept of the end, where it says what is allowed.
_END = 200
_CUT = " … "


class InputError(ValueError):
    """Bad input from outside: a file, a key, a value.

    The message is one line that names the file, surface or key, says what was wrong
    and what is allowed.  Command-line programs print it and exit with a non-zero status.
    Whatever it quotes, it can be printed: control characters are written out (`\\x1b`), and the
    middle of an endless message is left out.

    Attributes:
        whole: the message with its middle.
    """

    def __init__(self, message: object = "") -> None:
        self.whole = text = readable(message)
        if len(text) > _LONGEST:
            text = text[: _LONGEST - _END - len(_CUT)] + _CUT + text[-_END:]
        super().__init__(text)


def one_line(problem: object) -> str:
    """Return a message on one line, as every message of a user's mistake is."""
    return " ".join(str(problem).split())


def readable(text: object) -> str:
    """Return text on one line, in which what cannot be printed is written out as in Python."""
    found = str(text)
    if not found.isprintable():
        found = "".join(
            letter if letter.isprintable() else letter.encode("unicode_escape").decode()
            for letter in one_line(found)
        )
    return found


# A number that has a comma for its point.
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?", re.ASCII)


def comma_hint(value: object) -> str:
    """Return what to say of a number with a decimal comma, such as `1,5`, or of several with
    slashes between, such as the nd/Vd of a glass; empty for all else.
    """
    parts = value.split("/") if isinstance(value, str) else []
    comma = any(_DECIMAL_COMMA.fullmatch(part.strip()) for part in parts)
    return " (it has a decimal comma; write a point)" if comma else ""


def check_keys(given: Iterable[object], allowed: Iterable[str], where: str) -> None:
    """Refuse the first key that is not allowed.

    Args:
        given: keys that a user wrote, or a mapping with such keys.
        allowed: all keys that there are.
        where: what the keys are of; the message begins with it.

    Raises:
        InputError: a key that is not allowed; the message names the nearest one that is.
    """
    allowed = list(allowed)
    known = set(allowed)
    for key in given:
        if str(key) not in known:
            raise InputError(
                f"{where}: unknown key '{key}'{did_you_mean(str(key), allowed)} "
                f"(allowed: {', '.join(allowed) or 'none'})"
            )


def check_choice(value: object, allowed: Iterable[str], where: str) -> None:
    """Refuse a value that is not one of some words.

    Args:
        value: what a user wrote.
        allowed: all words that there are.
        where: the key; the message begins with it.

    Raises:
        InputError: another value; the message names the nearest allowed word.
    """
    allowed = list(allowed)
    if value not in allowed:
        raise InputError(
            f"{where}: '{value}' is unknown{did_you_mean(str(value), allowed)} "
            f"(allowed: {', '.join(allowed) or 'none'})"
        )


def check_count(key: str, number: Any, least: int = 1) -> None:
    """Refuse what is no integer of `least` or more.

    Raises:
        InputError: it is none.
    """
    if not (type(number) is int and number >= least):
        raise InputError(f"{key}: {number!r}; allowed: an integer of {least} or more")


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Return the end of a message about an unknown word: `; did you mean 'x'?`, or nothing."""
    near = difflib.get_close_matches(word[:_LONGEST_WORD], list(allowed), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""
