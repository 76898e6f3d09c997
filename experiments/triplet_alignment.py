"""Which element of a lens is misaligned, and by how much: one case, and many in one batch."""

import copy
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor

from dolens.alignment.element_fit import POSE, bounds, element_names, fit_element, named_element
from dolens.alignment.spot_moments import MomentModel, moment_model, simulated_moments
from dolens.errors import InputError
from dolens.imaging.spot_rays import gaussian_quadrature
from dolens.optics.lens import Lens
from experiments.settings import numbers_of
from experiments.tables import Row, write_table

logger = logging.getLogger(__name__)

_DIGITS = 9
# Radians and mm as tables have them: degrees and µm.
_UNITS = torch.tensor([math.degrees(1.0)] * 2 + [1e3] * 2, dtype=torch.float64)
COLUMNS = ("tilt_x_deg", "tilt_y_deg", "decenter_x_um", "decenter_y_um")


@dataclass(frozen=True)
class Alignment:
    """K misaligned lenses and what was found of them; poses are in degrees and µm.

    Attributes:
        element: (K,), number of the element that is off.
        true: (K, 4), its tilts and decentres.
        named: (K,), number of the element that fits best.
        found: (K, 4), the pose of that element.
        chi_squared: (E, K), of each element's fit.
        share: (E, K), of each hypothesis in the posterior.
        bound: (K, 4), least standard deviations, were the element known.
        correlation: (K, 4, 4), of the bound's covariance.
        converged: share of the fits of named elements that came to rest.
        seconds: of the fits of all hypotheses.
    """

    element: Tensor
    true: Tensor
    named: Tensor
    found: Tensor
    chi_squared: Tensor
    share: Tensor
    bound: Tensor
    correlation: Tensor
    converged: float
    seconds: float

    @property
    def right(self) -> Tensor:
        """(K,), bool: the element that is off is the one named."""
        return self.named == self.element

    def errors(self, columns: slice) -> Tensor:
        """(K,), length of the difference of the whole lens's pose, over these columns of all
        elements: a wrong name counts with what it invents and with what it misses.
        """
        difference = torch.zeros(len(self.true), len(self.chi_squared), 4, dtype=torch.float64)
        rows = torch.arange(len(self.true))
        difference[rows, self.named] += self.found
        difference[rows, self.element] -= self.true
        return difference[..., columns].flatten(1).norm(dim=1)


class TripletAlignmentModule(lightning.LightningModule):
    """Simulates spots of lenses with one element off, and finds which and by how much.

    Args:
        lens: as designed; it has two elements or more with poses.
        experiment: name of the experiment.
        fields: (x, y), degrees or mm; on all sides, for a misaligned lens has no symmetry.
        wavelengths: nm.
        folder: where tables go.
        demo: the first case: `element`, and any of `tilt_x`, `tilt_y` (degrees), `decenter_x`,
            `decenter_y` (mm).
        misalignments: how many more to draw: elements alike, tilts and decentres uniform.
        tilt_range: half-range of the tilts about x and y, degrees.
        decenter_range: half-range of the decentres, mm.
        photons: of each spot.
        rings: radii of the pupil's quadrature.
        arms: its azimuths.
        iterations: of each fit, at most.
        seed: of cases and noise.

    Raises:
        InputError: a setting out of range, a lens with fewer elements, an unknown element.
    """

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        fields: Sequence[Sequence[float]],
        wavelengths: Sequence[float],
        folder: str,
        demo: Mapping[str, Any],
        misalignments: int = 1000,
        tilt_range: float = 0.2,
        decenter_range: float = 0.05,
        photons: float = 1e5,
        rings: int = 4,
        arms: int = 12,
        iterations: int = 20,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.lens = lens.requires_grad_(False)
        self.elements = list(lens.elements)
        if len(self.elements) < 2:
            raise InputError("lens.elements: two or more are needed to tell one from another")
        if not (type(misalignments) is int and misalignments >= 1):
            raise InputError(f"misalignments: {misalignments!r}; allowed: an integer of 1 or more")
        for key, number in (("tilt_range", tilt_range), ("decenter_range", decenter_range)):
            if not 0.0 < number < math.inf:
                raise InputError(f"{key}: {number!r}; allowed: a positive number")
        self.experiment, self.folder, self.seed = experiment, Path(folder), int(seed)
        self.fields = [numbers_of("fields", field, 2) for field in fields]
        self.wavelengths = numbers_of("wavelengths", wavelengths)
        if not self.fields or not self.wavelengths:
            raise InputError("fields, wavelengths: give at least one (x, y) and one wavelength")
        self.misalignments, self.photons = misalignments, float(photons)
        tilt, shift = math.radians(tilt_range), float(decenter_range)
        self.half_range = torch.tensor([tilt, tilt, shift, shift], dtype=torch.float64)
        self.demo = self._demo(demo)
        self.rings, self.arms, self.iterations = rings, arms, iterations
        self.alignment: Alignment | None = None

    def configure_optimizers(self) -> None:
        """Nothing is trained."""

    def test_step(self, batch: Any, batch_idx: int) -> None:
        """Simulate, fit, log, and write the table."""
        # Lightning tests in inference mode, which forward derivatives do not work in.
        with torch.inference_mode(False), torch.no_grad():
            self.alignment = self._align()
        self.log_dict(self.summary(), batch_size=1)
        write_table(self.folder / "alignment.csv", self.rows(), _DIGITS)
        logger.info("%s", self._verdict())

    def summary(self) -> dict[str, float]:
        """Numbers for metrics.json, of the batch without the demo; none before the test."""
        found = self.alignment
        if found is None:
            return {}
        right = found.right[1:]
        numbers = {"alignment/named_right": float(right.double().mean())}
        for name, columns in (("tilt_deg", slice(0, 2)), ("decenter_um", slice(2, 4))):
            errors = found.errors(columns)
            numbers[f"pose_error/demo/{name}"] = float(errors[0])
            bound = found.bound[1:, columns].norm(dim=1)
            numbers[f"pose_bound/{name}/median"] = float(bound.median())
            for kind, chosen in (("", right), ("_all", torch.ones_like(right))):
                # Where no element is named right there is nothing to tell; NaN says so.
                some = errors[1:][chosen] if bool(chosen.any()) else errors.new_full((1,), math.nan)
                numbers[f"pose_error/{name}/median{kind}"] = float(some.quantile(0.5))
                numbers[f"pose_error/{name}/p95{kind}"] = float(some.quantile(0.95))
        ratio = (found.found - found.true) / found.bound
        rows = torch.arange(len(ratio))
        own = found.chi_squared[found.element, rows][1:]
        numbers["alignment/chi_squared/mean"] = float(own.mean())
        numbers["alignment/converged"] = found.converged
        for number, element in enumerate(self.elements):
            mine = (found.element == number) & found.right & (rows > 0)
            if not bool(mine.any()):
                continue
            for at, column in enumerate(COLUMNS):
                numbers[f"pose_bound/{element}/{column}"] = float(found.bound[mine, at].median())
                rms = float(ratio[mine, at].square().mean().sqrt())
                numbers[f"alignment/error_over_bound/{element}/{column}"] = rms
            # A tilt about x and a decentre along y move light in the same plane.
            for first, second in ((0, 3), (1, 2)):
                name = f"alignment/correlation/{element}/{POSE[first]}_{POSE[second]}"
                numbers[name] = float(found.correlation[mine, first, second].median())
        numbers["cost/batch_s"] = found.seconds
        return numbers

    def rows(self) -> list[Row]:
        """Of alignment.csv: the demo, and the batch."""
        found = self.alignment
        rows: list[Row] = []
        for k in range(len(found.true)):
            element, named = int(found.element[k]), int(found.named[k])
            row: dict[str, float | str] = {
                "case": "demo" if k == 0 else str(k),
                "true_element": self.elements[element],
                "named_element": self.elements[named],
                "share": float(found.share[named, k]),
            }
            for what in ("true", "found", "bound"):
                values = getattr(found, what)[k].tolist()
                row |= {f"{what}_{c}": v for c, v in zip(COLUMNS, values, strict=True)}
            chi_squared = found.chi_squared[:, k].tolist()
            row |= {f"chi2_{e}": v for e, v in zip(self.elements, chi_squared, strict=True)}
            rows.append(row)
        return rows

    def _align(self) -> Alignment:
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
        names = [element_names(lens, element) for element in self.elements]
        models = [moment_model(lens, spots, own) for own in names]
        whole = moment_model(lens, spots, sum(names, ()))
        generator = torch.Generator().manual_seed(self.seed)
        element, true = self._cases(generator)
        errors = torch.zeros(len(true), len(names), 4, dtype=torch.float64)
        errors[torch.arange(len(true)), element] = true
        measured = simulated_moments(whole, errors.flatten(1), self.photons, generator)

        started = time.perf_counter()
        fits = [fit_element(model, measured, self.iterations) for model in models]
        named, share = named_element([fit.chi_squared for fit in fits])
        seconds = time.perf_counter() - started
        rows = torch.arange(len(true))
        found = torch.stack([fit.errors for fit in fits])[named, rows]
        rested = torch.stack([fit.converged for fit in fits])[named, rows]
        covariance = _bounds(models, measured, element, true)
        bound = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        return Alignment(
            element,
            true * _UNITS,
            named,
            found * _UNITS,
            torch.stack([fit.chi_squared for fit in fits]),
            share,
            bound * _UNITS,
            covariance / (bound[:, :, None] * bound[:, None, :]),
            float(rested.double().mean()),
            seconds,
        )

    def _cases(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Elements (1 + K,) and poses (1 + K, 4) in radians and mm, the demo first."""
        element = torch.randint(len(self.elements), (self.misalignments,), generator=generator)
        shares = torch.rand((self.misalignments, 4), generator=generator, dtype=torch.float64)
        number, pose = self.demo
        return (
            torch.cat([torch.tensor([number]), element]),
            torch.cat([pose[None], (2.0 * shares - 1.0) * self.half_range]),
        )

    def _demo(self, settings: Mapping[str, Any]) -> tuple[int, Tensor]:
        unknown = set(settings) - {"element", *POSE}
        if unknown:
            raise InputError(f"demo: '{unknown.pop()}' is unknown; allowed: element, {POSE}")
        name = settings.get("element")
        if name not in self.elements:
            raise InputError(f"demo.element: '{name}'; allowed: {', '.join(self.elements)}")
        pose = torch.tensor([float(settings.get(part, 0.0)) for part in POSE], dtype=torch.float64)
        pose[:2] *= math.pi / 180.0
        return self.elements.index(name), pose

    def _verdict(self) -> str:
        n, found = self.summary(), self.alignment
        true, named = (self.elements[int(which[0])] for which in (found.element, found.named))
        return (
            f"demo: {true} is off, {named} is named, errors {n['pose_error/demo/tilt_deg']:.2g}° "
            f"and {n['pose_error/demo/decenter_um']:.2g} µm; of {self.misalignments} others "
            f"{100.0 * n['alignment/named_right']:.1f} % are named right, median errors "
            f"{n['pose_error/tilt_deg/median_all']:.2g}° and "
            f"{n['pose_error/decenter_um/median_all']:.2g} µm, 95 % within "
            f"{n['pose_error/tilt_deg/p95_all']:.2g}° and "
            f"{n['pose_error/decenter_um/p95_all']:.2g} µm ({found.seconds:.1f} s)"
        )


def _bounds(models: Sequence[MomentModel], measured: Any, element: Tensor, true: Tensor) -> Tensor:
    """(K, 4, 4), each of the element that is off."""
    covariance = torch.zeros(len(true), 4, 4, dtype=torch.float64)
    for number, model in enumerate(models):
        mine = torch.nonzero(element == number)[:, 0]
        if len(mine):
            covariance[mine] = bounds(model, measured[mine], true[mine])
    return covariance
