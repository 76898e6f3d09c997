"""Configurations of a Zemax `.zmx` file are states of one lens: zoom, focus.

`MNUM count current` begins the list behind the surfaces, and each line of it says what one operand
is in one configuration: `THIC 5 2 12.5` is a gap of 12.5 behind surface 5 in configuration 2.  The
surfaces are written as they are in the current one, and that is the lens itself; every
configuration that can be held becomes a state of it, under its title (LTTL) or as `c2`.

A configuration is read as the file would be, were it the current one: its numbers take the place of
those of the surfaces and the system.  One that cannot be held is passed over, and listed: where it
changes a glass, a type or the stop, where a solve would change the lens with it (its result is
written for the current configuration alone), or where its temperature differs (the numbers of such
a file are those at that temperature).  So are all but the current one of a file with more
configurations than a lens has states, or whose lines would be read too often for them.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from dolens.errors import InputError, comma_hint
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.numbers import number_in_text
from dolens.prescriptions.states import MOST_STATES
from dolens.prescriptions.system_data import PUPIL_KEYS
from dolens.prescriptions.zemax.file import Line, ZemaxFile

# Operand → the line of a surface, and the argument of it, that it sets.
_OF_SURFACES = {
    "THIC": ("DISZ", 0),
    "CRVT": ("CURV", 0),
    "CONN": ("CONI", 0),
    "SDIA": ("DIAM", 0),
    "APMN": ("CLAP", 0),
    "APMX": ("CLAP", 1),
}
# Operand → lists of the system, one number a field.
_OF_FIELDS = {
    "XFIE": ("XFLN", "XFLD"),
    "YFIE": ("YFLN", "YFLD"),
    "FLWT": ("FWGN", "FWGT"),
    "FVDX": ("VDXN", "ZVDX"),
    "FVDY": ("VDYN", "ZVDY"),
    "FVCX": ("VCXN", "ZVCX"),
    "FVCY": ("VCYN", "ZVCY"),
    "FVAN": ("VANN", "ZVAN"),
}
# Operand → which argument of WAVM it is, and lists of older files, one number a wavelength.
_OF_WAVELENGTHS: dict[str, tuple[int, tuple[str, ...]]] = {
    "WAVE": (1, ("WAVL", "WAVN")),
    "WLWT": (2, ("WWGT", "WWGN")),
}
_PUPILS = ("OBNA", "ENPD", "FNUM")
_AIR_OPERANDS = ("TEMP", "PRES")
_PARAMETER = re.compile(r"PAR(\d)")
_LISTS = {name for names in _OF_FIELDS.values() for name in names}
Read = Callable[[ZemaxFile], dict[str, Any]]
TITLE = "LTTL"
# What bends no ray: remarks, weights of configurations, mechanical sizes.
_SILENT = ("MOFF", "MCOM", TITLE, "CWGT", "CHZN", "MCSD", "CSUM", "HOLD")
# Solves of a surface, whose results hold for the current configuration.
_SOLVES = (
    *("MAZH", "MAZA", "CHZH", "CHZA", "EDGE", "EDGV", "OPDS", "PZUP", "PKUP", "PPAR", "PCON"),
    *("PXDT", "PIKC", "PIKT", "PIKD", "PIKG", "PIKK", "TOLE", "TCOM"),
)
_NAME = re.compile(r"[A-Za-z0-9_-]+")
# Lines of a file, once for each of its configurations: so many are read in seconds.
_MOST_LINES = 1_000_000
# Operands that are named in a sentence.
_NAMED = 8
# Keys of a prescription that a state may have for itself.
_WAVES = ("wavelengths", "wavelength_weights", "reference_wavelength")
_KEYS = ("fields", "object_distance", *_WAVES, *PUPIL_KEYS)


class Setting(NamedTuple):
    """A `Setting` is what an operand of configurations sets: of a surface, field or wavelength.

    Attributes:
        operand: such as `THIC`.
        number: of the surface, field or wavelength; 0 for the aperture of the system.
        parameter: of a surface, for `PRAM`; 0 for others.
    """

    operand: str
    number: int
    parameter: int = 0


def settings_of(file: ZemaxFile) -> dict[Setting, str]:
    """Return what a file says where configurations may set another number."""
    found: dict[Setting, str] = {}
    for operand, (first, _) in _OF_FIELDS.items():
        for n, word in enumerate(_last_words(file.system, first), 1):
            found[Setting(operand, n)] = word
    for line in file.system.get("WAVM", []):
        for operand, (at, _) in _OF_WAVELENGTHS.items():
            found[Setting(operand, int(line.arguments[0]))] = line.arguments[at]
    for pupil in _PUPILS:
        if pupil in file.system:
            found[Setting("APER", 0)] = _last_words(file.system, pupil)[0]
    for n, block in enumerate(file.surfaces):
        for operand, (kind, at) in _OF_SURFACES.items():
            for word in _last_words(block, kind)[at : at + 1]:
                found[Setting(operand, n)] = "1.0E+10" if word.upper() == "INFINITY" else word
        for line in block.get("PARM", []):
            found[Setting("PRAM", n, int(line.arguments[0]))] = line.arguments[1]
    return found


def settings_between(before: ZemaxFile, after: ZemaxFile, place: str) -> dict[Setting, str]:
    """Return the settings that make one file of another.

    Raises:
        InputError: the files differ in what no configuration can set; `place` begins the message.
    """
    own, others = settings_of(before), settings_of(after)
    for n, (one, other) in enumerate(
        zip([before.system, *before.surfaces], [after.system, *after.surfaces], strict=True), -1
    ):
        for operand in dict.fromkeys((*one, *other)):
            if operand in ("NAME", "PARM") or _fixed(one, operand) == _fixed(other, operand):
                continue
            if operand == "FTYP":
                same = _last_words(one, operand)[:1] == _last_words(other, operand)[:1]
                what = "as many fields and wavelengths" if same else "fields of one kind"
                raise InputError(f"{place}: a .zmx file has {what} in all its states")
            surface = f"surface {n}: " if n >= 0 else ""
            raise InputError(
                f"{place}: {surface}no configuration of a .zmx file can change {operand}"
            )
    settings = dict.fromkeys((*own, *others))
    return {s: others.get(s, "0.0") for s in settings if own.get(s) != others.get(s)}


def _fixed(lines: Mapping[str, list[Line]], operand: str) -> list[list[str]]:
    """Return the words of an operand without those that configurations may set."""
    set_at = {at for kind, at in _OF_SURFACES.values() if kind == operand}
    set_at |= {at for at, _ in _OF_WAVELENGTHS.values()} if operand == "WAVM" else set()
    set_at |= {0} if operand in _PUPILS else set()
    return [
        ["" if at in set_at or operand in _LISTS else w for at, w in enumerate(line.arguments)]
        for line in lines.get(operand, [])
    ]


def _last_words(lines: Mapping[str, list[Line]], operand: str) -> list[str]:
    return lines[operand][-1].arguments if operand in lines else []


def _apply_setting(file: ZemaxFile, line: Line) -> None:
    """Put the number of a line behind MNUM into its place among the surfaces and the system.

    Raises:
        InputError: the operand is none that is held, or its place is not there.
    """
    operand, (target, _, value) = line.operand, line.arguments[:3]
    at = int(number_in_text(target, f"line {line.at}"))
    parameter = _PARAMETER.fullmatch(operand)
    if operand in _OF_SURFACES:
        _replace(_surface(file, at, line), *_OF_SURFACES[operand], value)
    elif operand == "PRAM" or parameter:
        # Files of old have the parameter's number elsewhere.
        number = parameter[1] if parameter else (*line.arguments, *"00000")[4]
        lines = _surface(file, at, line).setdefault("PARM", [])
        if number == "0":
            raise InputError(f"{operand} of surface {at} does not say which parameter it is")
        lines[:] = [one for one in lines if one.arguments[:1] != [number]]
        lines.append(Line(line.at, "PARM", [number, value], f"{number} {value}"))
    elif operand in _OF_FIELDS:
        lists = [name for name in _OF_FIELDS[operand] if name in file.system]
        if not lists or "FEFD" in file.system:
            raise InputError(f"{operand} {at} has no place in the lists of fields")
        for name in lists:
            _replace(file.system, name, at - 1, value)
    elif operand in _OF_WAVELENGTHS:
        place, older = _OF_WAVELENGTHS[operand]
        lines = file.system.get("WAVM", [])
        for n, one in enumerate(lines):
            if one.arguments[:1] == [str(at)]:
                words = [*one.arguments, "1"][:3]
                lines[n] = one._replace(arguments=[*words[:place], value, *words[place + 1 :]])
        for name in older:
            if name in file.system and len(file.system[name][-1].arguments) >= at:
                _replace(file.system, name, at - 1, value)
    elif operand == "APER":
        given = [
            name
            for name in _PUPILS
            if name in file.system and number_in_text(file.system[name][-1].arguments[0], "")
        ]
        if "FLOA" in file.system or len(given) != 1:
            raise InputError("APER sets an aperture that the file does not have")
        _replace(file.system, given[0], 0, value)
    elif operand in _AIR_OPERANDS and not _indices_follow_air(file):
        return
    else:
        raise InputError(f"{operand} {target} is not held")


def _indices_follow_air(file: ZemaxFile) -> bool:
    lines = file.system.get("ENVD")
    return lines is not None and lines[-1].arguments[2:3] == ["1"]


def _surface(file: ZemaxFile, number: int, line: Line) -> dict[str, list[Line]]:
    if not 0 <= number < len(file.surfaces):
        raise InputError(f"{line.operand} {number}: there is no such surface")
    return file.surfaces[number]


def _replace(lines: dict[str, list[Line]], operand: str, place: int, value: str) -> None:
    """Replace an argument of an operand's last line."""
    if operand not in lines or len(lines[operand][-1].arguments) <= place or place < 0:
        raise InputError(f"there is no {operand} whose number would change")
    last = lines[operand][-1]
    words = [*last.arguments[:place], value, *last.arguments[place + 1 :]]
    if operand == "DIAM":
        # A size that is set is the user's own, not the program's.
        words[1:2] = ["1"]
    lines[operand] = [*lines[operand][:-1], last._replace(arguments=words, text=" ".join(words))]


def read_configurations(
    file: ZemaxFile, lens: dict[str, Any], read: Read, where: str
) -> tuple[dict[str, Any], list[str]]:
    """Return the states of a file's lens, as a prescription writes them, and sentences about the
    configurations that are passed over.

    Args:
        file: the lines.
        lens: the prescription of the current configuration.
        read: returns the prescription of a file's current configuration.
        where: name in messages.

    Raises:
        InputError: MNUM has no whole number, or a number has a decimal comma.
    """
    begin = file.system.get("MNUM")
    if not begin or not begin[-1].arguments:
        return {}, []
    place = f"{where}: line {begin[-1].at}: MNUM"
    words = (number_in_text(word, place) for word in (*begin[-1].arguments, "1")[:2])
    count, current = words
    if count != int(count) or current != int(current):
        raise InputError(f"{place} must have whole numbers, not '{begin[-1].text}'")
    count, current = int(count), int(current) or 1
    for line in file.configuration_lines():
        for word in line.arguments[:3]:
            if comma_hint(word):
                what = f"{where}: line {line.at}: {line.operand}"
                raise InputError(f"{what} must have numbers, not '{word}'{comma_hint(word)}")
    differ = _differing(file)
    if count < 2 or not differ:
        return {}, []
    shown = ", ".join([*differ[:_NAMED], *(["…"] if len(differ) > _NAMED else [])])
    said = f"which set {shown} (read: the current one, {current:.6g})"
    most = min(MOST_STATES, _MOST_LINES // _lines_of(file))
    if count > most:
        limit = f"a lens of this size has {most} states at most"
        return {}, [f"the other {count - 1:.6g} of {count:.6g} configurations, {said}: {limit}"]
    try:
        settings = _settings(file, set(differ), where)
    except InputError as problem:
        return {}, [f"the other {count - 1} of {count} configurations, {said}: {problem}"]
    held: dict[int, dict[str, Any]] = {}
    problems: dict[int, str] = {}
    for number in range(1, count + 1):
        try:
            held[number] = _of_configuration(file, settings.get(number, ()), lens, read)
        except InputError as problem:
            problems[number] = str(problem).removeprefix(f"{where}: ")
    states = _states(file, lens, held, current, where)
    for number in _unbuilt(lens, states, problems, where):
        del states[number]
    others = [number for number in range(1, count + 1) if number != current]
    lost = [number for number in others if number not in states]
    names = _names(file, states, lens)
    found = {names[number]: state for number, state in states.items() if names[number]}
    if not lost:
        return found, []
    why = problems.get(lost[0])
    why = f": {why}" if why else ""
    if len(lost) == len(others):
        return {}, [f"the other {len(lost)} of {count} configurations, {said}{why}"]
    numbers = ", ".join(map(str, lost))
    return found, [f"configurations {numbers} of {count}, {said}{why}"]


def _differing(file: ZemaxFile) -> list[str]:
    """Return the operands whose values differ between configurations, with their surfaces."""
    values: dict[str, set[str]] = {}
    for line in file.configuration_lines():
        if len(line.arguments) > 2 and line.operand not in _SILENT:
            values.setdefault(f"{line.operand} {line.arguments[0]}", set()).add(line.arguments[2])
    return [name for name, words in values.items() if len(words) > 1]


def _lines_of(file: ZemaxFile) -> int:
    """Return how many lines are read for each configuration."""
    blocks = (file.system, *file.surfaces)
    return 1 + sum(len(lines) for block in blocks for lines in block.values())


def _settings(file: ZemaxFile, differ: set[str], where: str) -> dict[float, list[Line]]:
    """Return the lines of each configuration that set what differs between them."""
    found: dict[float, list[Line]] = {}
    for line in file.configuration_lines():
        if line.operand in _SILENT or len(line.arguments) < 3:
            continue
        number = number_in_text(line.arguments[1], f"{where}: line {line.at}")
        if f"{line.operand} {line.arguments[0]}" in differ:
            found.setdefault(number, []).append(line)
    return found


def _of_configuration(
    file: ZemaxFile, settings: Sequence[Line], lens: dict[str, Any], read: Read
) -> dict[str, Any]:
    """Return the prescription of a configuration.

    Raises:
        InputError: it cannot be held; the message says why.
    """
    if file.skipped:
        raise InputError("the file leaves out numbers of surfaces")
    for solve in _SOLVES:
        for line in file.passed_over.get(solve, []):
            raise InputError(f"a solve holds for the current one ({solve} in line {line.at})")
    for n, lines in enumerate(file.surfaces):
        if "CURV" in lines and lines["CURV"][-1].arguments[1:2] not in ([], ["0"], ["1"]):
            raise InputError(f"a solve of surface {n} holds for the current one (CURV)")
    there = replace(
        file,
        system={key: [*lines] for key, lines in file.system.items()},
        surfaces=[{key: [*lines] for key, lines in block.items()} for block in file.surfaces],
    )
    for line in settings:
        _apply_setting(there, line)
    found = read(there)
    _refuse_other_structure(lens, found)
    return found


def _refuse_other_structure(lens: dict[str, Any], there: dict[str, Any]) -> None:
    for key in sorted((lens.keys() | there.keys()) - {"surfaces", "sensor", *_KEYS}):
        if lens.get(key) != there.get(key):
            raise InputError(f"it changes '{key}'")
    if lens["surfaces"].keys() != there["surfaces"].keys():
        raise InputError("it changes the number of surfaces")
    for n, row in lens["surfaces"].items():
        for key in ("type", "material", "phase"):
            if row.get(key) != there["surfaces"][n].get(key):
                raise InputError(f"surface {n}: it changes '{key}'")
    for key in sorted((lens["sensor"].keys() | there["sensor"].keys()) - {"distance"}):
        if lens["sensor"].get(key) != there["sensor"].get(key):
            raise InputError(f"the image: it changes '{key}'")


def _states(
    file: ZemaxFile,
    lens: dict[str, Any],
    held: dict[int, dict[str, Any]],
    current: int,
    where: str,
) -> dict[int, dict[str, Any]]:
    """Return the states: each says every number that differs in any of them."""
    varied = {
        (n, _canonical(key))
        for there in held.values()
        for n, row in lens["surfaces"].items()
        for key in row.keys() | there["surfaces"][n].keys()
        if row.get(key) != there["surfaces"][n].get(key)
    }
    moved = any(there["sensor"] != lens["sensor"] for there in held.values())
    system = {key for key in _KEYS if any(t.get(key) != lens.get(key) for t in held.values())}
    if system.intersection(_WAVES):
        # A state's wavelengths bring their weights and their reference with them.
        system |= set(_WAVES)
    found = {}
    for number, there in held.items():
        rows: dict[str, dict[str, Any]] = {}
        for n, key in sorted(varied, key=lambda pair: (int(pair[0]), pair[1])):
            row = there["surfaces"][n]
            said = {k: value for k, value in row.items() if _canonical(k) == key}
            rows.setdefault(n, {}).update(said or {key: 0.0})
        state: dict[str, Any] = {"surfaces": rows} if rows else {}
        if moved:
            state["sensor"] = {"distance": there["sensor"]["distance"]}
        for key in filter(system.__contains__, _KEYS):
            if key in there:
                state[key] = there[key]
            elif key == "object_distance":
                state[key] = float("inf")
        found[number] = state
    return found


def _canonical(key: str) -> str:
    return key.replace("curvature", "radius")


def _unbuilt(
    lens: dict[str, Any], states: dict[int, dict[str, Any]], problems: dict[int, str], where: str
) -> list[int]:
    """Return the states that make no lens, and write down why."""

    def build(some: dict[int, dict[str, Any]]) -> None:
        named = {f"c{number}": state for number, state in some.items()}
        lens_from_prescription({**lens, "states": named}, where=where)

    try:
        build(states)
    except InputError:
        found = []
        for number, state in states.items():
            try:
                build({number: state})
            except InputError as problem:
                problems[number] = str(problem).removeprefix(f"{where}: ")
                found.append(number)
        return found
    return []


def _names(
    file: ZemaxFile, states: dict[int, dict[str, Any]], lens: dict[str, Any]
) -> dict[int, str]:
    """Return the names of the states: their titles where these can be names, else `c2`; nothing of
    one whose title is the lens's own.
    """
    titles = {}
    for line in file.configuration_lines():
        if line.operand == TITLE and len(line.arguments) > 2:
            titles[int(number_in_text(line.arguments[1], ""))] = line.text.split('"')[1:2]
    names: dict[Any, Any] = {}
    for number in states:
        (title,) = titles.get(number) or [""]
        own = bool(_NAME.fullmatch(title)) and title not in names.values()
        names[number] = title if own else f"c{number}"
        if title == own_title(lens):
            names[number] = ""
    return names


def own_title(lens: Mapping[str, Any]) -> str:
    """Return the title of a configuration that is the lens itself and none of its states."""
    return f"the lens itself: {lens.get('name', '')}".strip()
