"""Analysis of a lens's sensitivities and tolerances."""

import copy
import logging
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.tolerancing import (
    Outcome,
    ToleranceAnalysis,
    analyse_tolerances,
    quantiles,
    share_within,
    spot_weights,
    tolerances_from,
)
from experiments.analysis import Analysis
from experiments.experiment import Figures
from experiments.settings import numbers_of
from experiments.tables import Row
from experiments.tolerances.figures import tolerance_figures
from experiments.tolerances.tables import (
    monte_carlo_rows,
    offender_rows,
    offender_text,
    sensitivity_rows,
)

logger = logging.getLogger(__name__)

QUANTILES = (0.5, 0.8, 0.9, 0.95, 0.98)


class TolerancesModule(Analysis):
    """Finds a lens's sensitivities to errors of manufacture, and the yield under tolerances.

    Radii are √(Σ W·RMS²) over the spots, each spot (a field and a wavelength) about its own
    centroid.  Perturbed lenses are refocused for all spots together unless a name says otherwise.

    Args:
        lens: as designed; any elements with poses of their own are in its prescription.
        experiment: name of the experiment.
        fields: (x, y), degrees or mm; on all sides, for a perturbed lens has no symmetry.
        wavelengths: nm.
        tolerances: see `tolerances_from`.
        folder: where tables go.
        lenses: how many to draw.
        tolerance_factor: multiplies every half-range.
        weights: of the fields; None: equal.
        rings: radii of the pupil's quadrature.
        arms: its azimuths.
        yield_at_um: limits of the RMS radius, µm.
        chunk_size: lenses traced at a time; None leaves it to `trace_perturbed`.
        seed: of the lenses drawn.
    """

    digits: ClassVar[int] = 9

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        fields: Sequence[Sequence[float]],
        wavelengths: Sequence[float],
        tolerances: Mapping[str, Any],
        folder: str,
        lenses: int = 4000,
        tolerance_factor: float = 1.0,
        weights: Sequence[float] | None = None,
        rings: int = 4,
        arms: int = 12,
        yield_at_um: Sequence[float] = (),
        chunk_size: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(lens, experiment, folder)
        for key, number in (("lenses", lenses), ("chunk_size", chunk_size)):
            if number is not None and not (type(number) is int and number >= 1):
                raise InputError(f"{key}: {number!r}; allowed: an integer of 1 or more")
        self.fields = [numbers_of("fields", field, 2) for field in fields]
        self.wavelengths = numbers_of("wavelengths", wavelengths)
        for key, given in (("fields", self.fields), ("wavelengths", self.wavelengths)):
            if not given:
                raise InputError(f"{key}: none is given")
        self.tolerances = tolerances_from(lens, tolerances, tolerance_factor)
        self.weights = self._weights(weights)
        self.lenses, self.chunk_size = lenses, chunk_size
        self.rings, self.arms = rings, arms
        self.yield_at_um = numbers_of("yield_at_um", yield_at_um)
        self.seed = seed
        self.analysis: ToleranceAnalysis | None = None

    def analyse(self) -> dict[str, float]:
        """Find sensitivities, draw lenses, and trace them."""
        self.analysis = self._analyse()
        numbers = self._metrics(self.analysis)
        logger.info("Worst offenders, each alone and refocused:\n%s", offender_text(self.analysis))
        logger.info("%s", self._verdict(numbers))
        return numbers

    def tables(self) -> dict[str, Iterable[Row]]:
        """Return `sensitivities`, `worst_offenders` and `monte_carlo`."""
        found = self.analysis
        return {
            "sensitivities": sensitivity_rows(found),
            "worst_offenders": offender_rows(found),
            "monte_carlo": monte_carlo_rows(found),
        }

    def figures(self) -> Figures:
        """Return the matrices, the yield curves and the worst offenders."""
        return tolerance_figures(self.analysis, self.lens.name, self._spot_labels(), self.weights)

    def _metrics(self, found: ToleranceAnalysis) -> dict[str, float]:
        increase = (1e3 * found.sensitivities.increase()).tolist()
        numbers = {
            f"sensitivity/rms_um/{name}": value
            for name, value in zip(found.tolerances.names, increase, strict=True)
        }
        numbers |= self._outcome("tolerance", found.traced, True)
        numbers |= self._outcome("tolerance/before_refocus", found.traced, False)
        numbers |= self._outcome("tolerance/linear", found.linear, True)
        numbers |= self._outcome("tolerance/linear_before_refocus", found.linear, False)
        numbers["tolerance/linear/expected_rms_um"] = 1e3 * found.contributions.expected_rms
        numbers["tolerance/failed_lenses"] = float((found.perturbed.failed > 0.0).double().mean())
        numbers["tolerance/vignetted_share"] = float(found.perturbed.vignetted.mean())
        numbers["cost/lenses_per_s"] = self.lenses / found.seconds
        for stage in ("", "_before_refocus"):
            traced = numbers[f"tolerance{stage.replace('_', '/', 1)}/rms_um/p90"]
            linear = numbers[f"tolerance/linear{stage}/rms_um/p90"]
            numbers[f"error/linear_p90{stage}"] = abs(linear / traced - 1.0)
        numbers["cost/rays"] = float(self.lenses * len(found.spots.weight))
        return numbers

    def _spot_labels(self) -> list[str]:
        """Return the field and the wavelength of every spot."""
        spots = self.analysis.spots
        unit = "°" if self.lens.object_distance is None else " mm"
        pairs = zip(spots.fields.tolist(), spots.wavelengths.tolist(), strict=True)
        labels = [f"({x:g}, {y:g}){unit}  {wave:.0f} nm" for (x, y), wave in pairs]
        return [label.replace("-", "−") for label in labels]

    def _analyse(self) -> ToleranceAnalysis:
        # Squares of small differences need double precision, whatever the lens is kept in.
        lens = copy.deepcopy(self.lens).double()
        spots = gaussian_quadrature(
            lens,
            self.fields,
            self.wavelengths,
            self.rings,
            self.arms,
            lens.object_distance,
            symmetry=False,
        )
        generator = torch.Generator().manual_seed(self.seed)
        return analyse_tolerances(
            lens, spots, self.tolerances, self.weights, self.lenses, generator, self.chunk_size
        )

    def _outcome(self, name: str, outcome: Outcome, refocused: bool) -> dict[str, float]:
        """Return quantiles of RMS radii, yields, and the radii of the lens as designed."""
        found = outcome.found(refocused)
        s = self.analysis.sensitivities
        design = s.rms_refocused if refocused else s.rms
        nominal = {"rms": float((design.square() @ self.weights).sqrt())}
        nominal["worst_rms"] = float(design[self.weights > 0.0].amax())
        numbers = {}
        for what, radii in (("rms", found.rms), ("worst_rms", found.worst)):
            numbers[f"{name}/{what}_um/nominal"] = 1e3 * nominal[what]
            for share, radius in zip(QUANTILES, quantiles(radii, QUANTILES), strict=True):
                numbers[f"{name}/{what}_um/p{100 * share:g}"] = 1e3 * radius
        for limit in self.yield_at_um:
            numbers[f"{name}/yield_at_{limit:g}um"] = share_within(found.rms, 1e-3 * limit)
            numbers[f"{name}/worst_yield_at_{limit:g}um"] = share_within(found.worst, 1e-3 * limit)
        return numbers

    def _verdict(self, n: Mapping[str, float]) -> str:
        parts = [
            f"{what} {n[f'{where}/rms_um/nominal']:.2f} as designed, median "
            f"{n[f'{where}/rms_um/p50']:.2f}, 90 % within {n[f'{where}/rms_um/p90']:.2f}"
            for what, where in (
                ("refocused", "tolerance"),
                ("by the linear model", "tolerance/linear"),
                ("not refocused", "tolerance/before_refocus"),
            )
        ]
        return (
            f"RMS radius, µm, of {self.lenses} lenses: {'; '.join(parts)} "
            f"({n['cost/lenses_per_s']:.0f} lenses/s)"
        )

    def _weights(self, weights: Sequence[float] | None) -> Tensor:
        """Return weights of spots (S,) from those of fields; all wavelengths count alike."""
        if weights is not None:
            weights = torch.tensor(numbers_of("weights", weights, len(self.fields)))
            weights = weights.double().repeat_interleave(len(self.wavelengths))
        return spot_weights(weights, len(self.fields) * len(self.wavelengths))
