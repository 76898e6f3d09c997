"""Each key of a lens file is changed, and the lens that is loaded is judged by what it computes."""

import copy
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.other_programs import ReadPrescription
from tests.prescriptions.computed import Computed

# A longer distance is infinite.
_FAR = 1e10
# A quoted text, what ends a command, or a word.
_WORD = re.compile(r"""'[^']*'|"[^"]*"|[;&]|[^\s;&'"]+""")


@dataclass
class Verdict:
    """Holds the places of the keys of one file by what a change of each did.

    Attributes:
        used: the lens computes something else.
        refused: the file is refused.
        listed: the list of what is passed over names it, or changed with it.
        named: it has no optical meaning, and the test says why.
        missed: none of these.
    """

    used: list[Any] = field(default_factory=list)
    refused: list[Any] = field(default_factory=list)
    listed: list[Any] = field(default_factory=list)
    named: list[Any] = field(default_factory=list)
    missed: list[Any] = field(default_factory=list)


def judge(
    content: Any,
    changes: Iterable[tuple[Any, Any]],
    read: Callable[[Any], ReadPrescription],
    is_named: Callable[[Any], bool],
    is_listed: Callable[[Any, list[str]], bool],
) -> Verdict:
    """Judge every key of a file.

    Args:
        content: the file.
        changes: place of a key, and the file with that key changed.
        read: reads the file.
        is_named: whether a place has no optical meaning.
        is_listed: whether a list of what is passed over names a place.
    """
    before = read(content)
    # Plain data are changed in their place.
    kept = copy.deepcopy(before.prescription)
    own, verdict = Computed(lens_from_prescription(kept, backend="cpu")), Verdict()
    for place, changed in changes:
        if is_named(place):
            verdict.named.append(place)
            continue
        try:
            found = read(changed)
            differs = found.prescription != kept and own.differs(
                lens_from_prescription(found.prescription, backend="cpu")
            )
        except InputError:
            verdict.refused.append(place)
            continue
        listed = found.passed_over != before.passed_over or is_listed(place, found.passed_over)
        (verdict.used if differs else verdict.listed if listed else verdict.missed).append(place)
    return verdict


def other(value: Any) -> Any:
    """Return another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}x"
    if isinstance(value, int):
        return value + 1
    return 1.01 * value + 0.01 if abs(value) < _FAR else -3.0


def leaves(content: Any, place: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Yield the place and value of each number, text and truth value of plain data; of a square
    array of numbers those on its diagonal.
    """
    if isinstance(content, dict | list):
        entries = list(content.items() if isinstance(content, dict) else enumerate(content))
        lists = [entry for _, entry in entries if isinstance(entry, list)]
        square = len(entries) > 3 and [len(one) for one in lists] == [len(entries)] * len(entries)
        for key, value in entries:
            if square:
                yield (*place, key, key), value[key]
            else:
                yield from leaves(value, (*place, key))
    elif content is not None:
        yield place, content


def changed_data(content: Any) -> Iterator[tuple[tuple, Any]]:
    """Yield the place of each value of plain data, and the data with it changed, in its place."""
    for place, value in list(leaves(content)):
        inside = content
        for key in place[:-1]:
            inside = inside[key]
        inside[place[-1]] = other(value)
        yield place, content
        inside[place[-1]] = value


def words_of(text: str) -> Iterator[tuple[tuple[str, int, str], int, int]]:
    """Yield (line, number of the word, word) of each argument in a text of commands, and where it
    begins and ends.
    """
    at = 0
    for line in text.splitlines(keepends=True):
        count = 0
        for found in _WORD.finditer(line):
            word = found[0]
            count = 0 if word in ";&" else count + 1
            if count > 1:
                yield (line.strip(), count - 1, word), at + found.start(), at + found.end()
        at += len(line)


def changed_text(text: str) -> Iterator[tuple[tuple[str, int, str], str]]:
    """Yield the place of each argument of a text, and the text with it changed."""
    for place, begin, end in words_of(text):
        yield place, f"{text[:begin]}{_other_word(place[2])}{text[end:]}"


def text_with_commas(text: str) -> Iterator[tuple[tuple[str, int, str], str]]:
    """Yield the place of each number with a decimal point, and the text with a comma there."""
    for place, begin, end in words_of(text):
        word = place[2]
        if re.fullmatch(r"[-+]?\d+\.\d+([eE][-+]?\d+)?", word):
            yield place, f"{text[:begin]}{word.replace('.', ',')}{text[end:]}"


# Another catalogue of glass; a name that is not known may be one that has it.
_OTHERS = {"SCHOTT": "HOYA", "OHARA": "HOYA"}


def _other_word(word: str) -> str:
    if word in _OTHERS:
        return _OTHERS[word]
    if re.fullmatch(r"[-+]?\d+", word):
        return str(int(word) + 1)
    try:
        return repr(other(float(word)))
    except ValueError:
        return f"{word[:-1]}X{word[-1]}" if word[0] in "'\"" else f"{word}X"
