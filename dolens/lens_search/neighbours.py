"""Forms near a lens: starts are drawn about it, also with the stop elsewhere, and grown as those of
a search are.

Where all its elements have one glass, elements are also taken out of it and put in elsewhere, as
the best forms of a search are led to others.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, cycle, pairwise
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.conditions import conditions
from dolens.errors import InputError, check_keys
from dolens.lens_search.arrangement import STOP, Arrangement
from dolens.lens_search.designs import Designs, element_powers
from dolens.lens_search.glass.glass_merit import merit_of
from dolens.lens_search.growth import Stage, finish, grow
from dolens.lens_search.search import SearchPlan, Step, escapes
from dolens.lens_search.short_search import LensSearch, check_amounts, collected
from dolens.lens_search.specification import Limits, Specification
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.optics.system import require_one_index
from dolens.optimize.merit import evaluate_operands
from dolens.optimize.operands import Operand
from dolens.tasks import TaskMap

# Of growth: the lens does what it must already, and its neighbours nearly do.
_STAGES = (Stage(5.0 / 3.0, 0.7, iterations=20), Stage(1.0, 1.0, iterations=60, kept=0.5))
_BATCH = 25
# From the lens to a stop in front of it or behind it, over the focal length.
_OUTSIDE = 0.05
# Limits over the lens's own thicknesses, air spaces, distortion, track and back focus.
_LESS, _MORE, _TRACK, _BACK_FOCUS = 0.8, 1.25, 1.05, 0.95
_EDGE = 0.005


@dataclass(frozen=True)
class KnownLens:
    """A lens as a search has it.

    Attributes:
        specification: its task, and its own glasses.
        arrangement: the order of its elements.
        values: u, (P,); see `Arrangement`.
    """

    specification: Specification
    arrangement: Arrangement
    values: Tensor

    @staticmethod
    def of(lens: Lens, limits: Mapping[str, Any], vignetting: float) -> KnownLens:
        """Return a lens as a search has it.

        Args:
            lens: of spheres and planes, in air, for an object at infinity.
            limits: that replace those of the lens's own numbers.
            vignetting: see `Specification`.

        Raises:
            InputError: what no search has, as a mirror, an asphere or a stop within glass.
        """
        check_keys(limits, sorted(Limits.__dataclass_fields__), "limits")
        where = conditions(lens)
        _check_kinds(lens, where.object_distance)
        first = lens.first_order(lens.primary_wavelength)
        f, number = first.efl.item(), abs(first.f_number.item())
        if not f > 0.0:
            raise InputError(
                f"search_neighbours: lens '{lens.name}' has the focal length {f:.4g} mm; allowed: "
                "a positive one"
            )
        order = _Order.of(lens)
        angles = {round(float(point.norm()), 9) for point in where.fields}
        own = _limits(order, lens, f, max(angles), where.object_distance)
        specification = Specification(
            focal_length=f,
            f_number=number,
            fields=tuple(sorted({0.0, *angles})),
            wavelengths=tuple(where.wavelengths.tolist()),
            reference_wavelength=where.reference_wavelength,
            groups=order.groups,
            glasses=order.glasses,
            vignetting=vignetting,
            limits=Limits(**{**own, **limits}),
        )
        lengths = torch.tensor([*order.gaps, order.image], dtype=torch.float64) / f
        curvatures = torch.tensor(order.curvatures, dtype=torch.float64) * f
        arrangement = Arrangement.of(specification, order.stop)
        return KnownLens(specification, arrangement, torch.cat([curvatures, lengths]))

    def steps(self, plan: SearchPlan, spread: float, map_tasks: TaskMap) -> Iterator[Step]:
        """Yield what grows of starts about the lens, and of elements put in elsewhere."""
        own = self.arrangement.stop
        others = [n for n in range(len(self.arrangement.groups) + 1) if n != own]
        stops = cycle([own, *others])
        bounds = pairwise([*range(0, plan.starts, plan.batch), plan.starts])
        tasks = [(next(stops), first, end) for first, end in bounds]
        yield from map_tasks(partial(self.grown, plan, spread), tasks, "batches of starts")
        if len(set(self.specification.element_glasses)) > 1 or self.specification.elements < 2:
            # An element that is taken out takes its glass with it.
            return
        yield from map_tasks(
            partial(escapes, self.specification, plan), [self.designs(plan)], "elements moved"
        )

    def grown(self, plan: SearchPlan, spread: float, task: tuple[int, int, int]) -> Step:
        """Grow starts about the lens with the stop in some place, the lens itself as number 0."""
        stop, first, end = task
        arrangement = Arrangement.of(self.specification, stop)
        merit = merit_of(arrangement, self.specification, plan.rings, plan.arms)
        generator = torch.Generator().manual_seed(1_000_003 * plan.seed + first)
        s, image = arrangement.surfaces, arrangement.image_column
        drawn = torch.randn(end - first, len(self.values), generator=generator).double() * spread
        if first == 0:
            drawn[0] = 0.0
        starts = self.with_stop(arrangement).expand_as(drawn).clone()
        starts[:, :s] += drawn[:, :s]
        starts[:, s:image] *= drawn[:, s:image].exp()
        lower, upper = merit.box(starts)
        starts = torch.maximum(torch.minimum(starts, upper), lower)
        better = grow(merit, starts, _STAGES).best(plan.finished)
        done = finish(merit, better, plan.finish_rounds, plan.finish_iterations)
        words = "near the lens" if stop == self.arrangement.stop else "stop elsewhere"
        history = ((words,),) * len(done.values)
        designs = Designs.of(arrangement, done, first + done.starts, history)
        features = element_powers(arrangement, starts, merit)
        return Step((designs.keeping(plan.tolerance),), features, first, done.iterations)

    def with_stop(self, other: Arrangement) -> Tensor:
        """Return the values (P,) of the same surfaces with the stop in another space of air: in its
        middle, or a little in front of the lens or behind it.
        """
        if other == self.arrangement:
            return self.values
        s, image = other.surfaces, other.image_column
        gaps = [0.0, *self.values[s:image].tolist()]
        at = dict(zip(self.arrangement.sequence, accumulate(gaps), strict=True))
        sensor = sum(gaps) + float(self.values[image])
        place = other.stop_place
        before = at[other.sequence[place - 1]] if place > 0 else at[0] - 2.0 * _OUTSIDE
        last = place == len(other.sequence) - 1
        behind = before + 2.0 * _OUTSIDE if last else at[other.sequence[place + 1]]
        at[STOP] = 0.5 * (before + behind)
        along = [at[n] for n in other.sequence]
        lengths = [b - a for a, b in pairwise(along)]
        return torch.cat([self.values[:s], self.values.new_tensor([*lengths, sensor - along[-1]])])

    def designs(self, plan: SearchPlan) -> Designs:
        """Return the lens as a parent of others."""
        merit = merit_of(self.arrangement, self.specification, plan.rings, plan.arms)
        values = self.values[None]
        none = torch.zeros(1, dtype=torch.float64)
        start = torch.zeros(1, dtype=torch.int64)
        spots = merit.spots(values, merit.full(1))
        return Designs(self.arrangement, values, spots, none, start, (("the lens",),))


@dataclass(frozen=True)
class _Order:
    """The refracting surfaces of a lens, and its stop, in the order of a search; lengths in mm."""

    groups: tuple[int, ...]
    glasses: tuple[str, ...]
    stop: int
    curvatures: tuple[float, ...]
    gaps: tuple[float, ...]
    image: float
    thick: tuple[float, ...]
    air: tuple[float, ...]
    back_focus: float
    track: float

    @staticmethod
    def of(lens: Lens) -> _Order:
        where = [0.0]
        for gap in lens.thicknesses.values():
            where.append(where[-1] + gap.item())
        sensor = where[-1] + lens.sensor_distance.item()
        media = lens.materials
        glass = [is_glass(medium) for medium in media]
        groups: list[int] = []
        curvatures, places = [], []  # of what refracts
        stop, sequence = None, []
        for n in range(1, len(where) + 1):
            before, behind = glass[n - 1], glass[n]
            refracts = before or behind
            if n == lens.stop and not refracts:
                stop = len(groups)
                sequence.append(where[n - 1])
                continue
            if n == lens.stop and before and behind:
                raise InputError(
                    f"search_neighbours: the stop of lens '{lens.name}' lies in glass; allowed: "
                    "in air, or on a surface beside air"
                )
            if not refracts:
                continue
            if behind:
                groups[-1:] = [groups[-1] + 1] if before else [*groups[-1:], 1]
            if n == lens.stop and not before:  # in front of the group that begins here
                stop = len(groups) - 1
                sequence.append(where[n - 1])
            curvature = getattr(lens.surfaces[str(n)], "curvature", None)
            curvatures.append(0.0 if curvature is None else curvature.item())
            places.append((where[n - 1], behind))
            sequence.append(where[n - 1])
            if n == lens.stop and before:
                stop = len(groups)
                sequence.append(where[n - 1])
        pairs = list(pairwise(places))
        return _Order(
            tuple(groups),
            tuple(m.name for m, is_one in zip(media, glass, strict=True) if is_one),
            0 if stop is None else stop,
            tuple(curvatures),
            tuple(b - a for a, b in pairwise(sequence)),
            sensor - sequence[-1],
            tuple(b[0] - a[0] for a, b in pairs if a[1]),
            tuple(b[0] - a[0] for a, b in pairs if not a[1]),
            sensor - places[-1][0],
            sensor - sequence[0],
        )


def _check_kinds(lens: Lens, object_distance: float | None) -> None:
    """Refuse a lens that no search has."""
    name = f"search_neighbours: lens '{lens.name}'"
    if object_distance is not None:
        raise InputError(f"{name} has a near object; allowed: one at infinity")
    for number, surface in lens.surfaces.items():
        if surface.coating is not None:
            raise InputError(
                f"{name}: surface {number} has a coating, and a search's lenses have none; search "
                "from lens.coated('ideal')"
            )
        if surface.diffractive is not None:
            raise InputError(f"{name}: surface {number} is diffractive; a search's lenses are not")
        others = {n for n, p in surface.named_parameters() if bool((p != 0.0).any())}
        if others - {"curvature"} or surface.law is not None or surface.changes_axes:
            raise InputError(f"{name}: surface {number}; allowed: spheres and planes in line")
    mirrors = any(medium.name == "mirror" for medium in lens.materials)
    if (
        mirrors
        or lens.reversals
        or any(p.item() != 0.0 for e in lens.elements.values() for p in e.parameters())
    ):
        raise InputError(f"{name} has mirrors or tilted elements; allowed: refraction in line")
    require_one_index(lens.system(), f"{name}: a search")
    if lens.index_model != "dfc" or not any(map(is_glass, lens.materials)):
        raise InputError(f"{name}: allowed: elements of glass with index_model dfc")
    if is_glass(lens.materials[0]) or is_glass(lens.materials[-1]):
        raise InputError(f"{name} begins or ends in glass; allowed: a lens in air")


def _limits(
    order: _Order, lens: Lens, f: float, edge: float, object_distance: float | None
) -> dict[str, Any]:
    """Return limits that the lens keeps, with some room."""
    thick, air = order.thick, order.air or (0.1 * f,)
    distortion = 0.01
    if edge > 0.0:
        of_edge = Operand("distortion", min=0.0, field=(0.0, edge))
        (found,) = evaluate_operands([of_edge], lens, object_distance).numbers()
        distortion = max(distortion, _MORE * abs(found.value) / 100.0)
    return {
        "glass": (_LESS * min(thick), max(_MORE * max(thick), 0.1 * f)),
        "air": (max(0.0, min(_LESS * min(air), 0.002 * f)), max(_MORE * max(air), 0.2 * f)),
        "glass_edge": _EDGE * f,
        "back_focus": max(0.0, _BACK_FOCUS * order.back_focus),
        "track": _TRACK * order.track,
        "distortion": distortion,
    }


class SearchMethods:
    """The method of `Lens` that searches for others near it."""

    def search_neighbours(
        self,
        starts: int = 200,
        seconds: float | None = None,
        forms: int = 10,
        spread: float = 1.0,
        limits: Mapping[str, Any] | None = None,
        vignetting: float = 0.0,
        seed: int = 0,
    ) -> LensSearch:
        """Search for forms near this lens that do the same task with its glasses.

        Focal length, F-number, fields, wavelengths and glasses are the lens's own.  Starts are
        drawn about it, also with the stop in other spaces, grown and finished as those of
        `dolens.search`; the first is the lens itself.  Where all elements have one glass, elements
        are also taken out and put in elsewhere.  Aspheres, mirrors and near objects are refused.

        Args:
            starts: how many are drawn.
            seconds: after so many no further task begins; see `dolens.search`.
            forms: how many of the best forms are checked and returned.
            spread: standard deviation of the curvatures, over the focal length, and of the
                logarithm of the gaps.
            limits: of `dolens.lens_search.specification.Limits`, mm, in the place of the lens's own
                numbers: glass no thinner than 0.8 of its thinnest, track 1.05 of its own at most,
                back focus 0.95 at least, distortion 1.25 at most, or 1 %.
            vignetting: share of the light of the outermost field that apertures may clip.
            seed: of the starts.

        Raises:
            InputError: a number out of range, or a lens that no search has.

        Example:
            >>> lens = dolens.load_lens("cooke_triplet")
            >>> near = lens.search_neighbours(starts=25, forms=1)
            >>> near[0].powers
            '+ − | +'
        """
        started = time.perf_counter()
        check_amounts(starts, forms, seed, seconds)
        if not isinstance(spread, int | float) or not 0.0 <= spread < 10.0:
            raise InputError(f"spread: {spread!r}; allowed: 0 to below 10")
        known = KnownLens.of(as_lens(self), limits or {}, vignetting)
        plan = SearchPlan(starts=starts, batch=_BATCH, seed=seed)

        def steps(map_tasks: TaskMap) -> Iterator[Step]:
            return known.steps(plan, float(spread), map_tasks)

        return collected(known.specification, plan, steps, forms, started, seconds)


def as_lens(methods: Any) -> Lens:
    """Return the lens whose method this is, in double precision."""
    return methods.storing_its_values().double()
