"""A surface of a Zemax `.zmx` file is a block of lines, read as numbers in mm.

`CURV 0.02 0 0 0 0 ""` gives a curvature and how it is solved for; only the number is read.  `PARM n
value` and `XDAT n value` are the numbers of a shape, of which each TYPE has a list of its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

from dolens.errors import InputError
from dolens.prescriptions.decimals import number_in_text, radius_of, scaled
from dolens.prescriptions.zemax import Line

# The text of a zero that a writer gives a coefficient which a prescription names.  Zemax lists
# zeros (`0`, `0.000000000000E+000`) of all coefficients, named or not.
NAMED_ZERO = "0.0"


@dataclass(frozen=True)
class SurfaceBlock:
    """A `SurfaceBlock` holds the lines of one surface.

    Attributes:
        lines: operand → its lines.
        factor: mm in the file's unit of length.
        place: name of the surface in messages.
        before: the medium before it, as a prescription writes it.
        material: the medium behind it.
        stop: whether it is the stop.
    """

    lines: Mapping[str, list[Line]]
    factor: Fraction
    place: str
    before: str = "air"
    material: str = "air"

    @property
    def stop(self) -> bool:
        """Return whether the file says STOP here."""
        return "STOP" in self.lines

    def words(self, operand: str) -> list[str]:
        """Return the arguments of an operand's last line; none where it has no line."""
        return self.lines[operand][-1].arguments if operand in self.lines else []

    def number(self, operand: str) -> float:
        """Return the first argument of an operand, 0 where it has none.

        Raises:
            InputError: it is no finite number.
        """
        return number_in_text((self.words(operand) or ["0"])[0], f"{self.place}: {operand}")

    def length(self, operand: str, power: int = 1) -> float:
        """Return the first argument of an operand, a length to a power, in mm^power."""
        word = (self.words(operand) or ["0"])[0]
        return scaled(word, self.factor**power, f"{self.place}: {operand}")

    @property
    def type(self) -> str:
        """Return the word behind TYPE in capitals; a file that does not say it means STANDARD."""
        return (self.words("TYPE") or ["STANDARD"])[0].upper()

    @property
    def curvature(self) -> float:
        """Return the curvature, 1/mm."""
        return self.length("CURV", -1)

    @cached_property
    def parameters(self) -> dict[int, str]:
        """Return the numbers of PARM as they are written, by their own numbers."""
        return self._numbered("PARM")

    @cached_property
    def extra_data(self) -> dict[int, str]:
        """Return the numbers of XDAT as they are written, by their own numbers."""
        return self._numbered("XDAT")

    def parameter(self, n: int, power: int = 0) -> float:
        """Return PARM n, a length to a power, in mm^power; 0 where the file does not give it."""
        return scaled(self.parameters.get(n, "0"), self.factor**power, f"{self.place}: PARM {n}")

    def extra(self, n: int, power: int = 0) -> float:
        """Return XDAT n, a length to a power, in mm^power; 0 where the file does not give it."""
        return scaled(self.extra_data.get(n, "0"), self.factor**power, f"{self.place}: XDAT {n}")

    def _numbered(self, operand: str) -> dict[int, str]:
        found = {}
        for line in self.lines.get(operand, []):
            what = f"{self.place}: {operand} (line {line.at})"
            if len(line.arguments) < 2:
                raise InputError(f"{what}: needs a number from 1 and a value")
            n = number_in_text(line.arguments[0], what)
            if n < 0 or n != int(n):
                raise InputError(
                    f"{what}: must have a whole number from 0, not {line.arguments[0]}"
                )
            number_in_text(line.arguments[1], what)
            found[int(n)] = line.arguments[1]
        return found


def curvature_row(curvature: float) -> dict[str, float]:
    """Return `radius` as a prescription writes it, or `curvature` where no radius means its last
    bit.
    """
    radius = radius_of(curvature)
    return {"curvature": curvature} if radius is None else {"radius": radius}
