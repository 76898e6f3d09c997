"""Words of a CODE V `.seq` file that bend no ray are listed; zoom positions are compared."""

import re

from dolens.errors import InputError
from dolens.prescriptions.codev.file import CodeVFile
from dolens.prescriptions.decimals import number_in_text

# What the first of several positions must say as the lens itself does.
_SYSTEM = ("EPD", "FNO", "NA", "NAO")
# Lists of wavelengths and fields, one number each; `ZOO WTW W2 1 0` is about the second.
_LISTS = (
    "WL",
    "WTW",
    "WTF",
    *(f"{axis}{kind}" for axis in "XY" for kind in ("AN", "OB", "IM", "RI")),
)
_LISTED = re.compile(r"[WF]([1-9]\d{0,2})")


def passed_over(file: CodeVFile) -> list[str]:
    """Return what a file says besides its lens, in words."""
    found = []
    positions = _positions(file)
    if positions > 1:
        rest = "position 2" if positions == 2 else f"positions 2 to {positions}"
        found.append(f"{rest} of {positions} (ZOO); position 1 is read")
    blocks = file.surfaces
    if any(_has_use(block.commands, ("EDG", "HOL")) for block in blocks):
        found.append("edges and holes, which CODE V draws (EDG, HOL)")
    if any(_is_solve(block.commands) for block in blocks):
        found.append("solves, whose values are written (THI, CUY)")
    groups = {group: ", ".join(keys) for group, keys in file.passed_over.items() if group}
    return [*found, *(f"{group} ({keys})" for group, keys in groups.items())]


def require_first_position(file: CodeVFile, where: str) -> None:
    """Check that a file's lens is that of its first zoom position.

    Raises:
        InputError: the first value of ZOO is not the one that the lens has.
    """
    for command in file.zoom:
        words = command.words
        if len(words) < 3 or words[0].upper() not in (*_SYSTEM, *_LISTS, "THI"):
            continue
        key, label = words[0].upper(), words[1].upper()
        place = f"{where}: line {command.at}: ZOO {key}"
        if key in _SYSTEM:
            own, first = file.system.get(key), words[1]
            value = own[-1].words[0] if own and own[-1].words else None
        elif key in _LISTS:
            listed = _LISTED.fullmatch(label)
            if listed is None:
                continue
            numbers, at, first = file.system.get(key), int(listed[1]) - 1, words[2]
            # Weights that are not written are 1, and coordinates 0.
            value = "1" if key.startswith("WT") else None if key == "WL" else "0"
            if numbers and at < len(numbers[-1].words):
                value = numbers[-1].words[at]
        else:
            block = next((b for b in file.surfaces if b.label == label), None)
            given = block.words[1:2] if block else []
            for thickness in block.commands.get("THI", []) if block else []:
                given = thickness.words[:1] or given
            value, first = (given[0] if given else None), words[2]
        if value is None or number_in_text(value, place) != number_in_text(first, place):
            raise InputError(f"{place}: position 1 has {first}, and the lens {value or 'none'}")


def _positions(file: CodeVFile) -> int:
    counts = [command.words[0] for command in file.zoom if len(command.words) == 1]
    return int(counts[-1]) if counts and counts[-1].isdecimal() and len(counts[-1]) < 5 else 1


def _has_use(commands: dict, uses: tuple[str, ...]) -> bool:
    return any(
        word.upper() in uses
        for key in ("CIR", "REX", "REY")
        for command in commands.get(key, [])
        for word in command.words
    )


def _is_solve(commands: dict) -> bool:
    return any(
        command.words and command.words[0].isalpha()
        for key in ("THI", "CUY", "RDY")
        for command in commands.get(key, [])
    )
