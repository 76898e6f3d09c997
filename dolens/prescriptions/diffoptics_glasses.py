"""Glasses are named in diffoptics lens files."""

import re

from dolens.errors import InputError, comma_hint, did_you_mean

# nd/Vd as diffoptics tabulates them (its index model counts them from 589.3 nm).
DIFFOPTICS_GLASSES = {
    "b270": "1.52290/58.50",
    "baf10": "1.67/47.05",
    "bk10": "1.49780/66.954",
    "d-k59": "1.5175/63.50",
    "f15": "1.60570/37.831",
    "f2": "1.620/36.37",
    "flint": "1.6200/36.37",
    "n-baf10": "1.67003/47.11",
    "n-bk7": "1.51680/64.17",
    "n-sf1": "1.71736/29.62",
    "n-sf10": "1.72828/28.53",
    "n-sf11": "1.78472/25.68",
    "n-sf2": "1.64769/33.82",
    "n-sf4": "1.75513/27.38",
    "n-sf5": "1.67271/32.25",
    "n-sf6": "1.80518/25.36",
    "n-sf6ht": "1.80518/25.36",
    "n-sf8": "1.68894/31.31",
    "pmma": "1.491756/58.00",
    "polycarb": "1.585470/30.00",
    "s-nph1": "1.8078/22.76",
    "sf1": "1.71736/29.51",
    "sf18": "1.72150/29.245",
    "sf2": "1.64769/33.85",
    "sf4": "1.75520/27.58",
    "sf5": "1.67270/32.21",
    "sf6": "1.80518/25.43",
    "sk1": "1.61030/56.712",
    "sk16": "1.62040/60.306",
    "ssk4": "1.61770/55.116",
    "uvfs": "1.458/67.82",
}
_MEDIA = {"air": "air", "occluder": "occluder", "vacuum": "occluder"}
_PAIR = re.compile(r"\d+(\.\d+)?/\d+(\.\d+)?")


def diffoptics_material(name: str, place: str) -> str:
    """Return a medium of the diffoptics format as a prescription writes it.

    A name stands for diffoptics's own nd and Vd, not for a catalogue's dispersion.  Vacuum is the
    medium that a prescription writes `occluder`: index 1 in every index model.

    Raises:
        InputError: one line that names the place and a near name.
    """
    word = name.lower()
    known = _MEDIA | DIFFOPTICS_GLASSES
    if word not in known and not _PAIR.fullmatch(word):
        raise InputError(
            f"{place}: material '{name}' is unknown{did_you_mean(word, known)} (allowed: nd/Vd, "
            "such as 1.5168/64.17, air, occluder, vacuum, or a glass in diffoptics's own table)"
            f"{comma_hint(name)}"
        )
    return known.get(word, word)
