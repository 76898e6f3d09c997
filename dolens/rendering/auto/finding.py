"""One decision of a plan."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One decision of a plan.

    Attributes:
        what: what was decided.
        chosen: what for.
        error: what it costs in accuracy, grey levels on the probe.
        because: why.
    """

    what: str
    chosen: str
    error: float
    because: str

    def __str__(self) -> str:
        return f"{self.what}: {self.chosen} ({self.error:.2g} grey levels; {self.because})"
