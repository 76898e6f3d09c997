"""Analysis of a lens's sensitivities and tolerances."""

import copy
import logging
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.analysis.conditions import field_shares
from dolens.analysis.fields_and_wavelengths import spectral_shares
from dolens.errors import InputError, check_count
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.settings import Spots, numbers_of
from dolens.experiments.tables import Row
from dolens.experiments.tolerances.tolerance_report import (
    monte_carlo_rows,
    offender_rows,
    offender_text,
    sensitivity_rows,
    tolerance_figures,
)
from dolens.experiments.workers import workers_of
from dolens.optics.fabrication_errors import names_fabrication_errors
from dolens.optics.lens import Lens
from dolens.plotting.layout import lens_title
from dolens.tasks import stage as named_stage
from dolens.tolerancing import (
    Outcome,
    ToleranceAnalysis,
    analyse_tolerances,
    quantiles,
    share_within,
    spot_weights,
    tolerances_from,
)

logger = logging.getLogger(__name__)

QUANTILES = (0.5, 0.8, 0.9, 0.95, 0.98)


@dataclass(frozen=True)
class MonteCarlo:
    """Lenses with errors drawn at random.

    Attributes:
        lenses: how many.
        chunk_size: how many are traced at a time; None leaves it to `trace_perturbed`.
        seed: of the errors.

    Raises:
        InputError: a number that is no integer of 1 or more.
    """

    lenses: int
    chunk_size: int | None
    seed: int

    def __post_init__(self) -> None:
        check_count("lenses", self.lenses)
        if self.chunk_size is not None:
            check_count("chunk_size", self.chunk_size)


class TolerancesModule(Analysis):
    """Finds a lens's sensitivities to errors of manufacture, and the yield under tolerances.

    Radii are √(Σ W·RMS²) over the spots, each spot (a field and a wavelength) about its own
    centroid.  Perturbed lenses are refocused for all spots together unless a name says otherwise.

    Args:
        lens: as designed; any elements with poses of their own are in its prescription.
        spots: by which a lens is judged.
        weights: of the spots' fields; None: the lens's own where the fields are, else equal.  Those
            of wavelengths are the lens's own where they are, else equal.
        tolerances: see `tolerances_from`.
        tolerance_factor: multiplies every half-range.
        monte_carlo: the lenses drawn.
        yield_at_um: limits of the RMS radius, µm.
        workers: where lenses are traced; see `workers_of`.

    Raises:
        InputError: a setting is out of range.
    """

    digits: ClassVar[int] = 9

    metrics = (
        "tolerance/rms_um/*",
        "tolerance/worst_rms_um/*",
        "tolerance/yield_at_*",
        "tolerance/worst_yield_at_*",
        "tolerance/before_refocus/*",
        "tolerance/linear/*",
        "tolerance/linear_before_refocus/*",
        "tolerance/failed_lenses",
        "tolerance/vignetted_share",
        "sensitivity/rms_um/*",
        "error/linear_p90*",
    )

    def __init__(
        self,
        lens: Lens,
        spots: Spots,
        weights: Sequence[float] | None,
        tolerances: Mapping[str, Any],
        tolerance_factor: float,
        monte_carlo: MonteCarlo,
        yield_at_um: Sequence[float],
        workers: int | str | None = None,
    ) -> None:
        super().__init__(lens)
        self.spots = spots
        self.weights = self._weights(weights)
        self.tolerances = tolerances_from(lens, tolerances, tolerance_factor)
        for name in filter(names_fabrication_errors, self.tolerances.names):
            raise InputError(
                f"tolerances.{name}: allowed here: parameters of the lens, which rays have "
                "derivatives by; a camera's made lenses may have this error"
            )
        self.monte_carlo = monte_carlo
        self.yield_at_um = numbers_of("yield_at_um", yield_at_um)
        # Chunks of this process have threads of their own, which changes no bit.
        self.workers = None if workers is None else workers_of(workers)
        self.analysis: ToleranceAnalysis | None = None

    def analyse(self) -> dict[str, float]:
        """Find sensitivities, draw lenses, and trace them."""
        with named_stage("sensitivities and drawn lenses"):
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
        title = lens_title(self.lens, self.lens.object_distance)
        return tolerance_figures(self.analysis, title, self._spot_labels(), self.weights)

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
        numbers["cost/lenses_per_s"] = self.monte_carlo.lenses / found.seconds
        for stage in ("", "_before_refocus"):
            traced = numbers[f"tolerance{stage.replace('_', '/', 1)}/rms_um/p90"]
            linear = numbers[f"tolerance/linear{stage}/rms_um/p90"]
            numbers[f"error/linear_p90{stage}"] = abs(linear / traced - 1.0)
        traced = int((self.weights > 0.0)[found.spots.spot.cpu()].sum())
        numbers["cost/rays"] = float(self.monte_carlo.lenses * traced)
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
        drawn = self.monte_carlo
        with nullcontext() if self.workers is None else self.workers.open() as map_tasks:
            return analyse_tolerances(
                lens,
                self.spots.rays(lens),
                self.tolerances,
                self.weights,
                drawn.lenses,
                torch.Generator().manual_seed(drawn.seed),
                drawn.chunk_size,
                map_tasks,
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
            f"RMS radius, µm, of {self.monte_carlo.lenses} lenses: {'; '.join(parts)} "
            f"({n['cost/lenses_per_s']:.0f} lenses/s)"
        )

    def _weights(self, weights: Sequence[float] | None) -> Tensor:
        """Return weights of spots (S,) from those of fields and the lens's own of wavelengths."""
        fields = torch.tensor(self.spots.fields, dtype=torch.float64)
        if weights is None:
            of_fields = field_shares(self.lens, fields)
        else:
            of_fields = fields.new_tensor(numbers_of("weights", weights, len(fields)))
        of_waves = spectral_shares(self.lens, self.spots.wavelengths)
        return spot_weights(torch.outer(of_fields, of_waves).flatten(), len(self.spots))
