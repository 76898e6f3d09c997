"""What `scipy_on_merit.py` and `optiland_on_merit.py` share: a task, its finish, and the table."""

import json
import statistics
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from search_parts import task

from dolens.lens_search.arrangement import AIR, Arrangement
from dolens.lens_search.growth import settled
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.search import SearchPlan

Array = NDArray[np.float64]
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Task:
    """The merit function of an experiment's last stage, and the plan of its finish.

    Attributes:
        merit: of the search, its stop in one place.
        plan: of the experiment.
    """

    merit: SearchMerit
    plan: SearchPlan

    @staticmethod
    def of(experiment: str, stop: int) -> "Task":
        """Return that of an experiment.

        Args:
            experiment: its name.
            stop: behind how many groups the stop stands.
        """
        specification, plan = task(experiment)
        arrangement = Arrangement.of(specification, stop)
        return Task(SearchMerit.of(arrangement, specification, plan.rings, plan.arms), plan)

    def bounds(self, curved: float) -> list[tuple[float, float]]:
        """Return the bounds of the variables u.

        Args:
            curved: greatest curvature times the focal length.
        """
        lower, upper = (end.clone() for end in self.merit.bounds())
        surfaces = self.merit.arrangement.surfaces
        lower[:surfaces], upper[:surfaces] = -curved, curved
        return list(zip(lower.tolist(), upper.tolist(), strict=True))

    def as_plain(self, curved: float) -> dict[str, Any]:
        """Return the task as `plain_task.PlainTask` reads it, in mm.

        Args:
            curved: greatest curvature times the focal length.
        """
        merit, arrangement = self.merit, self.merit.arrangement
        specification, rays = merit.specification, merit.rays
        table = merit.family.table(merit.family.start[None]).indices[0].tolist()
        ends = merit.scales * torch.tensor(self.bounds(curved), dtype=torch.float64).T
        chiefs = rays.chiefs
        return {
            "focal_length": specification.focal_length,
            "f_number": specification.f_number,
            "wavelengths": list(specification.wavelengths),
            "reference": specification.reference,
            "field_tangents": rays.slopes.tolist(),
            "chief_tangents": rays.tangent[len(rays.tangent) - chiefs :].tolist(),
            "sequence": list(arrangement.sequence),
            "in_glass": [medium != AIR for medium in arrangement.media_behind],
            # Rows: in front of the pupil's plane, behind it, and behind each of the sequence.
            "indices": table[2 : 2 + arrangement.gaps],
            "terms": list(arrangement.terms or (0,) * arrangement.surfaces),
            "scales": merit.scales.tolist(),
            "lower": ends[0].tolist(),
            "upper": ends[1].tolist(),
            "weight_of_limits": merit.operand_weight,
            "limits": asdict(specification.limits),
            "pupil": rays.pupil.tolist(),
            **{n: getattr(rays, n).tolist() for n in ("tangent", "weight", "group", "wavelength")},
        }

    def finished(self, u: Array | None) -> float | None:
        """Return the mean RMS spot, µm, of a lens after the search's own finish; None where it
        breaks its specification.
        """
        if u is None:
            return None
        lens = torch.from_numpy(np.asarray(u, dtype=np.float64))[None]
        done = settled(self.merit, lens, self.plan.finish_rounds, self.plan.finish_iterations)
        deviations = done.merit.deviations(done.values, done.conditions)
        broken = torch.where(done.merit.is_limit, deviations.clamp(min=0.0), deviations.abs())
        spot = 1e3 * float(done.merit.spots(done.values, done.conditions).mean())
        return spot if float(broken.amax()) < _TOLERANCE and np.isfinite(spot) else None


@dataclass(frozen=True)
class Run:
    """One search of one method.

    Attributes:
        experiment: the task.
        method: its name.
        seed: of its random numbers.
        seconds: of processor time that it had.
        lenses: that it traced.
        values: u of its best lens; None where rays of all lenses failed.
        spot: mean RMS spot, µm, of that lens after the search's finish; None where it breaks its
            specification.
    """

    experiment: str
    method: str
    seed: int
    seconds: float
    lenses: int
    values: list[float] | None
    spot: float | None

    def path(self, folder: Path) -> Path:
        """Return where it is kept."""
        name = f"{self.experiment}_{self.method}_{self.seed}".replace(" ", "_")
        return folder / f"{name}.json"

    def keep(self, folder: Path) -> None:
        """Write it as a file."""
        folder.mkdir(parents=True, exist_ok=True)
        self.path(folder).write_text(json.dumps(asdict(self)))


def kept(folder: Path, experiment: str) -> list[Run]:
    """Return the runs of an experiment in a folder, by method and seed."""
    found = [Run(**json.loads(path.read_text())) for path in folder.glob("*.json")]
    own = [run for run in found if run.experiment == experiment]
    return sorted(own, key=lambda run: (run.method, run.seed))


def table(runs: Iterable[Run]) -> str:
    """Return a Markdown table with a row a method, and of it the spots by seed."""
    by_method: dict[str, list[Run]] = {}
    for run in runs:
        by_method.setdefault(run.method, []).append(run)
    lines = [
        "| method | runs | seconds | lenses | mean RMS spots of those that keep the limits, µm |",
        "|---|---|---|---|---|",
    ]
    for method, own in by_method.items():
        spots = ", ".join("none" if run.spot is None else f"{run.spot:.4g}" for run in own)
        lenses = statistics.median(run.lenses for run in own)
        cells = [method, str(len(own)), f"{own[0].seconds:g}", f"{lenses:.2g}", spots]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
