"""The gradient-index media behind Zemax's surfaces GRINSUR1 to GRINSUR5.

Their surface is that of TYPE STANDARD, and PARM has the profile of the medium behind it: PARM 1 is
the largest step of a ray, which dolens chooses itself, PARM 2 the index at the vertex (its square
for GRINSUR2), and the others are coefficients, in the file's unit of length.

Source: OpticStudio's help, "Gradient 1" to "Gradient 5".
"""

import math

from dolens.errors import InputError
from dolens.optics.gradients import TERMS
from dolens.prescriptions.zemax.file import SurfaceBlock

# TYPE → terms of PARM 3, PARM 4, ...
GRADIENTS: dict[str, tuple[str, ...]] = {
    "GRINSUR1": ("r2",),
    "GRINSUR2": ("r2", "r4", "r6", "r8", "r10", "r12"),
    "GRINSUR3": ("r2", "r4", "r6", "z", "z2", "z3"),
    "GRINSUR4": ("x", "x2", "y", "y2", "z", "z2"),
    "GRINSUR5": ("r2", "r4", "z", "z2", "z3", "z4"),
}
_SQUARED = "GRINSUR2"
# The tangents of GRINSUR5's tilts, and what they are about.
TILTS = dict.fromkeys(("PARM 9", "PARM 10"), "a tilted surface in front of a gradient is not held")


def gradient_medium(block: SurfaceBlock) -> str | None:
    """Return the medium behind a surface as a prescription writes it; None where it has no profile.

    Raises:
        InputError: the index is not positive, or its dispersion stands in another file.
    """
    terms = GRADIENTS.get(block.type)
    if terms is None:
        return None
    if block.words("GLAS"):
        raise InputError(
            f"{block.place}: a gradient-index medium with a dispersion of its own is not held "
            f"(GLAS {block.words('GLAS')[0]}, which stands in a file of Zemax's)"
        )
    n = block.slot("PARM 2")
    if not n > 0.0:
        raise InputError(
            f"{block.place}: PARM 2, the index at the vertex, must be positive, not {n:g}"
        )
    squared = block.type == _SQUARED
    powers = {term: int(term[1:] or 1) for term in TERMS}
    values = {term: block.slot(f"PARM {slot}", -powers[term]) for slot, term in enumerate(terms, 3)}
    base = repr(math.sqrt(n) if squared else n)
    words = [f"{term}={value!r}" for term, value in values.items() if value]
    return " ".join([f"gradient{'_squared' * squared}", base, *words]) if words else base
