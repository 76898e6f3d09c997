"""A found lens is a lens that a search ended with, and the way that led to it."""

from dataclasses import dataclass

from dolens.optics.lens import Lens


@dataclass(frozen=True, eq=False)
class FoundLens:
    """Holds a lens that a search found.

    Attributes:
        lens: in double precision, with its stop, fields and wavelengths.
        merit: what the search made small; the least is the best.
        rms_spot_um: µm, the RMS spot radius of each field of the lens, in their order.
        start: number of the start that it came from.
        history: what was done to the start, in words: `inserted at 3`, `glass of 2`.
    """

    lens: Lens
    merit: float
    rms_spot_um: tuple[float, ...]
    start: int
    history: tuple[str, ...] = ()

    @property
    def mean_rms_spot_um(self) -> float:
        """Return the mean of the RMS spot radii over the fields, µm."""
        return sum(self.rms_spot_um) / len(self.rms_spot_um)
