"""What a job answers: numbers with their units, their errors, a picture, and lenses.

The server reads answers too, and does not load PyTorch for it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.optics.lens import Lens

_DIGITS = 8
# Rounding of lengths in mm, and of all else.
_NOTHING = 1e-14

Prescription = Mapping[str, Any]


@dataclass
class Answer:
    """What a job found.

    Attributes:
        values: numbers and words; a key ends in its unit, as `efl_mm`; None is a number that is not
            finite, as that of a field which no light reaches.
        errors: what each approximate number errs by.
        notes: a sentence each.
        picture: PNG, or None.
        lenses: name that is wanted → prescription, of new lenses.
        file: content of a file that is to be written.
    """

    values: dict[str, Any]
    errors: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    picture: bytes | None = None
    lenses: list[tuple[str, Prescription]] = field(default_factory=list)
    file: bytes | None = None

    def errs(self, of: str, by: Any, unit: str, how: str) -> None:
        """Say what a number errs by.

        Args:
            of: its key.
            by: how much; None where no number is known.
            unit: of `by`; may be empty.
            how: where the error comes from, and how it was found.
        """
        self.errors.append({"of": of, "by": plain(by), "unit": unit, "how": how})

    def show(self, figure: "Figure | None", wanted: bool) -> None:
        """Take a figure as the picture, if one is wanted."""
        if wanted and figure is not None:
            from dolens.mcp.pictures import png_of_figure

            self.picture = png_of_figure(figure)

    def add(self, lens: "Lens", name: str = "") -> None:
        """Add a new lens; without a name it is named after the one that it was made of."""
        from dolens.prescriptions import prescription_of

        self.lenses.append((name, prescription_of(lens)))


def plain(value: Any) -> Any:
    """Return plain values for JSON: tensors as lists, eight digits, None for what is not finite."""
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return float(f"{value:.{_DIGITS}g}") if abs(value) > _NOTHING else 0.0
    return value
