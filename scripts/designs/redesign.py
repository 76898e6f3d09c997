"""A design of others is made again from a start, for its own spots and under its own limits."""

import copy
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optimize import DampedLeastSquares, DesignVariables
from dolens.optimize.merit import MeritFunction
from dolens.optimize.operands import operand
from dolens.optimize.ray_intercept_quality import RayInterceptResiduals
from scripts.designs.files import Design
from scripts.designs.lenses import (
    Measures,
    beams,
    before_lens,
    lens_of,
    measures,
    operands_of,
    set_edges,
)

# µm of spot that a millimetre beyond a limit costs, and how far inside it that begins, mm: a step
# knows of a limit that it is beyond.
_WEIGHT, _MARGIN = 500.0, 1e-3
# Rings and arms of the rays of a merit function.
_RINGS, _ARMS = 6, 12
# How far a start is from the design, at most: the largest of these with which every ray passes.
_AWAY = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
# What a degree of slope or incidence counts as, mm: half of one is no more than room.  The steps do
# not know of angles; `kept` looks.
_DEGREE = 0.004
# A lens that distorts less than this part of what it may is not watched for it; `kept` looks.
_FAR = 0.5
# Of its gain a round without which no other follows.
_WORTH = 1e-4

# Makes one step, and says whether more can be gained.
Step = Callable[[MeritFunction], bool]


def variables_of(design: Design, lens: Lens, published: Measures) -> dict[str, dict[str, Any]]:
    """Return settings of `DesignVariables`: what the design's file does not hold.

    Args:
        design: whose file it is.
        lens: as it is at first.
        published: says what the solved curvature holds, and the least back focus.
    """
    found: dict[str, dict[str, Any]] = {}
    for number, surface in enumerate(design.surfaces, 1):
        if surface.refracting is not None:
            name = f"surfaces.{number}.curvature"
            if surface.refracting == design.solved:
                found[name] = {"solve": "efl", "target": published.efl}
            elif surface.refracting not in design.held["c"]:
                found[name] = {"scale": 0.01}
        height = lens.surfaces[str(number)].semi_diameter
        for n in range(len(surface.terms) - 1):
            found[f"surfaces.{number}.a{4 + 2 * n}"] = {"scale": 0.01 * height ** -(4 + 2 * n)}
        for n in range(len(surface.phase[0]) if surface.phase else 0):
            found[f"surfaces.{number}.phase.p{2 + 2 * n}"] = {"scale": 10.0}
        free = surface.spaced is not None and surface.spaced not in design.held["s"]
        if number < len(design.surfaces) and free:
            found[f"thicknesses.{number}"] = {"scale": 0.1}
    least = min(design.limits.back, published.back)
    if design.track is not None:
        # The last air space in front of what is held follows from the others.
        names = [f"thicknesses.{n}" for n in range(1, len(design.surfaces))]
        follows = next(n for n in reversed(names) if n in found)
        others = [n for n in (*names, "sensor_distance") if n != follows]
        whole = design.track + before_lens(lens, design)
        found[follows] = {"pickup": others, "factor": -1.0, "offset": whole}
        found["sensor_distance"] = {"scale": 0.1, "lower": least}
    elif design.surfaces[-1].spaced not in design.held["s"]:
        found["sensor_distance"] = {"scale": 0.1, "lower": max(least, 0.0)}
    return found


def limits_of(design: Design, published: Measures) -> list[dict[str, Any]]:
    """Return operands that hold what the specification asks for, or what the published lens keeps
    of it where that is less.
    """
    limits, found = design.limits, []
    scale = design.focal_length / published.efl
    most = max(limits.distortion, published.distortion)
    ranges: Mapping[str, Mapping[str, float]] = {
        "centre_thickness": {
            "min": min(limits.glass[0], published.glass[0]),
            "max": max(limits.glass[1], published.glass[1]),
        },
        "edge_thickness": {"min": min(limits.glass[0], published.glass[2])},
        "air_gap": {"min": min(limits.air, published.air[0])},
        "edge_air_gap": {"min": min(limits.air, published.air[1])},
        "total_track": {"max": published.total},
        "distortion": {
            "min": 100.0 * (scale * (1.0 - most) - 1.0),
            "max": 100.0 * (scale * (1.0 + most) - 1.0),
        },
    }
    for entry in operands_of(design, _WEIGHT):
        kind = str(entry["kind"])
        # A chief ray takes longer than all the rest, and that of the edge tells of the others.
        middle = kind == "distortion" and entry["field"] != design.angles[-1]
        far = kind == "distortion" and published.distortion < _FAR * limits.distortion
        held = kind == "total_track" and design.track is not None
        room = _MARGIN * (10.0 if kind == "distortion" else 1.0)
        sides = {"min": room, "max": -room}
        within = {k: v + sides[k] for k, v in ranges[kind].items() if math.isfinite(v)}
        if within and not (held or middle or far):
            found.append({**entry, **within})
    return found


def kept(now: Measures, published: Measures, design: Design, room: float = 2e-3) -> list[str]:
    """Return the names of limits that a lens breaks by more than `room`: mm, tenths of a share of
    distortion, or 250°.

    Args:
        now: the lens.
        published: what it is compared with.
        design: whose limits they are.
        room: what rounding and weights of a merit function leave.
    """
    limits = design.limits
    bounds = {
        "glass": min(limits.glass[0], published.glass[0]) - now.glass[0],
        "glass_most": now.glass[1] - max(limits.glass[1], published.glass[1]),
        "glass_edge": min(limits.glass[0], published.glass[2]) - now.glass[2],
        "air": min(limits.air, published.air[0]) - now.air[0],
        "air_edge": min(limits.air, published.air[1]) - now.air[1],
        "track": now.total - published.total,
        "back": min(limits.back, published.back) - now.back,
        "efl": abs(now.efl - published.efl),
        "incidence": _DEGREE * (now.incidence - max(limits.incidence, published.incidence)),
        "slope": _DEGREE * (now.slope - max(limits.slope, published.slope)),
        "distortion": 10.0 * (now.distortion - max(limits.distortion, published.distortion)),
    }
    return [name for name, beyond in bounds.items() if beyond > room]


@torch.no_grad()
def start_of(design: Design, published: Measures, seed: int = 0) -> tuple[Lens, float]:
    """Return the design with curvatures, aspheric surfaces and spaces drawn anew around their
    values, and by how much at most: the largest share with which every ray passes.

    A surface's polynomial is scaled as a whole.

    Raises:
        InputError: no share leaves every ray in the lens.
    """
    for away in _AWAY:
        generator = torch.Generator().manual_seed(seed)
        lens = lens_of(design)
        variables = DesignVariables(lens, variables_of(design, lens, published))
        values = {name: value.detach().clone() for name, value in variables().items()}
        factors: dict[str, float] = {}
        for name in values:
            part = name.rpartition(".a")[0] or name
            if part not in factors:
                drawn = 2.0 * float(torch.rand((), generator=generator, dtype=torch.float64)) - 1.0
                factors[part] = 1.0 + away * drawn
        chosen = [factors[n.rpartition(".a")[0] or n] for n in variables.names]
        variables.scaled.mul_(torch.tensor(chosen, dtype=torch.float64))
        variables.project()
        variables.write_to(lens)
        try:
            set_edges(lens, design)
            measures(lens, design)
        except InputError:
            continue
        return lens, away
    raise InputError(f"{design.name}: no start nearer than {_AWAY[-1]} lets every ray pass")


def least_squares(variables: DesignVariables) -> Step:
    """Return a step of dolens's damped least squares."""
    steps = DampedLeastSquares([variables.parameter_group()])

    def step(merit: MeritFunction) -> bool:
        steps.step(merit)
        return steps.stopped is None

    return step


def their_rule(variables: DesignVariables, settings: Mapping[str, float]) -> Step:
    """Return a step of Levenberg and Marquardt's method as the designs' authors damp it.

    (JᵀJ + λD²)δ = -Jᵀr; D_j is the largest |J_j| met, of which `beta` is kept; a step stands unless
    the loss grows to more than `tolerance` of itself, and λ falls where it has not grown.
    """
    memory: dict[str, Any] = {"damping": settings.get("lm_parameter", 1.0), "columns": None}
    tolerance, beta = settings.get("tolerance", 2.0), settings.get("beta", 0.99)
    more = settings.get("lam_increase_factor", 2.0)
    less = settings.get("lam_decrease_factor", 2.0)
    least = settings.get("lam_eps", 1e-6)

    @torch.no_grad()
    def step(merit: MeritFunction) -> bool:
        before = variables.scaled.detach().clone()
        with torch.enable_grad():
            value = merit()
            loss, model = value.sum_of_squares(), value.linear_model()
        columns, kept_columns = model.column_norms, memory["columns"]
        if kept_columns is not None:
            columns = beta * torch.maximum(columns, kept_columns) + (1.0 - beta) * columns
        memory["columns"] = columns.clamp(min=settings.get("damped_term_min", 1e-4))
        rows: Tensor = torch.cat(
            [model.root, math.sqrt(memory["damping"]) * torch.diag(memory["columns"])]
        )
        right = torch.cat([model.right, torch.zeros_like(columns)])
        found = torch.linalg.lstsq(rows, -right[:, None], driver="gelsd").solution[:, 0]
        variables.scaled.add_(found.to(variables.scaled))
        variables.project()
        ratio = merit().sum_of_squares() / loss
        if not ratio <= tolerance:
            variables.scaled.copy_(before)
        factor = 1.0 / less if ratio <= 1.0 else more
        memory["damping"] = min(max(memory["damping"] * factor, least), 1.0 / least)
        return True

    return step


@dataclass(frozen=True)
class Redesign:
    """A lens that was made again.

    Attributes:
        lens: the best of its rounds that keeps every limit; the last one's where none does.
        measures: what it is.
        broken: limits that it breaks.
        steps: how many were made.
        seconds: process time that they took.
    """

    lens: Lens
    measures: Measures
    broken: list[str]
    steps: int
    seconds: float


def redesigned(
    lens: Lens,
    design: Design,
    published: Measures,
    seconds: float,
    method: Callable[[DesignVariables], Step],
    rounds: int = 8,
    clock: Callable[[], float] = time.process_time,
) -> Redesign:
    """Return the lens after so much process time, with rays and edges chosen anew in each round.

    Args:
        lens: where it begins; it is not changed.
        design: the specification.
        published: what limits come from, see `limits_of`.
        seconds: of process time.
        method: variables → step.
        rounds: that the time is shared by, at least.
        clock: tells the seconds.
    """
    begun = clock()
    lens = copy.deepcopy(lens)
    variables = DesignVariables(lens, variables_of(design, lens, published))
    count = 0
    best: Redesign | None = None
    weights = torch.tensor(design.weights, dtype=torch.float64)
    weights = (weights / weights.sum()).repeat(design.fields) / design.fields
    operands = [operand(o, lens) for o in limits_of(design, published)]
    while clock() - begun < seconds:
        set_edges(lens, design)
        spots = beams(lens, design, _RINGS, _ARMS)
        quality = RayInterceptResiduals(spots, weights, "centroid", "polychromatic", 1.0)
        merit, step = MeritFunction(lens, variables, quality, operands), method(variables)
        until = min(begun + seconds, clock() + seconds / rounds)
        first = merit().sum_of_squares()
        more, count = step(merit), count + 1
        while more and clock() < until:
            more, count = step(merit), count + 1
        variables.write_to(lens)
        try:
            set_edges(lens, design)
            now = measures(lens, design)
        except InputError:
            break
        broken = kept(now, published, design)
        spent = clock() - begun
        found = Redesign(copy.deepcopy(lens), now, broken, count, spent)
        if best is None or (len(broken), now.mean) <= (len(best.broken), best.measures.mean):
            best = found
        if not more and first - merit().sum_of_squares() <= _WORTH * first:
            break
    if best is None:
        raise InputError(f"{design.name}: rays are lost in the first round")
    return replace(best, steps=count, seconds=clock() - begun)
