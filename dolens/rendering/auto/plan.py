"""A plan: the settings of a renderer that a scene needs, found from a few probe rays."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.diffraction.element_orders import has_orders
from dolens.diffraction.pixel_psf import diffraction_transfer, with_diffraction_limit
from dolens.rendering.auto.field_grid import (
    REGISTRATIONS,
    SAMPLES,
    WINDOW_SHARE,
    Decision,
    Pixels,
    Survey,
    choose_fields,
    spread_pixels,
    survey,
    window_decision,
)
from dolens.rendering.auto.probes import blurred_grey_levels, grey_levels
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

# Points of the sensor where functions are compared.
_POINTS = 24
_PUPIL_SAMPLES = (6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64)
# The share of the tolerance that each simplification may take; with those of
# `field_grid` their squares add up to less than 1.
_SAMPLING, _SHARING, _DIFFRACTION, _PRECISION = 0.5, 0.25, 0.3, 0.1
# Near an optimum the gradients of colours, and of depths, cancel; one in place of all turns their
# sum: a cosine of 0.3 with the rays' gradient was measured, in images a quarter grey level off.
_SHARING_OF_GRADIENTS = 0.005
# Points where wavefronts are asked.
_WAVES = 4
# Of all pupils whose waves a render may take: some ten seconds.
_MOST_SAMPLES = 1 << 28
# Pixels by which windows grow, for diffraction; the last is for comparison.
_MARGINS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64)
# Models of diffraction, from the least to the most exact.
_DIFFRACTION_MODELS = ("none", "limit", "orders", "wave")


@dataclass(frozen=True)
class Plan:
    """A renderer by point spread functions, what it is expected to err by, and why.

    Attributes:
        renderer: the settings.
        dtype: precision of rays and image.
        decisions: the decisions.
        without_diffraction: grey levels that leaving diffraction out costs, or would cost.
    """

    renderer: PsfRenderer
    dtype: torch.dtype
    decisions: tuple[Decision, ...]
    without_diffraction: float

    @property
    def expected_error(self) -> float:
        """Grey levels, as if the decisions' errors were independent."""
        return math.sqrt(sum(decision.error**2 for decision in self.decisions))


@dataclass(frozen=True)
class Requirements:
    """The conditions that a plan keeps to.

    Attributes:
        tolerance: RMS grey levels (1/255 of full scale, linear light) on the probe.
        gradients: whether the lens's gradients matter too.
        diffraction: whether it may be modelled.
        registrations: that may be chosen, of `PsfRenderer`.
    """

    tolerance: float
    gradients: bool
    diffraction: bool
    registrations: Sequence[str] = REGISTRATIONS


@torch.no_grad()
def plan(single: ImagingSystem, double: ImagingSystem, requirements: Requirements) -> Plan:
    """Choose fields, registration, window, pupil samples, what is shared, diffraction, precision.

    Args:
        single: the lens in single precision, depths and wavelengths, and the pixels.
        double: the same in double precision.
        requirements: the tolerance, and what is asked for.

    Raises:
        InputError: functions are too wide for any window.
    """
    scene, tolerance = double.scene, requirements.tolerance
    truth = survey(double, spread_pixels(double.sensor, _POINTS), SAMPLES)
    layout = choose_fields(truth, tolerance, requirements.registrations)
    renderer, distortion = layout.renderer, layout.renderer.registration == "chief_rays"
    functions = truth.functions(renderer.size, distortion)
    decisions = [layout.decision, window_decision(truth, renderer.size, distortion)]
    shared = (_SHARING_OF_GRADIENTS if requirements.gradients else _SHARING) * tolerance
    for name, decision in (
        ("depths", _shared_depths(functions, scene, shared)),
        ("colours", _shared_colours(functions, scene, shared)),
    ):
        chosen: dict[str, Any] = {name: decision.selected}
        renderer = replace(renderer, **chosen)
        decisions.append(decision)
    decision, without = _diffraction(functions, truth, renderer, tolerance)
    if not requirements.diffraction:
        decision = Decision(
            "diffraction", "none", 0.0, f"as asked for; it would change {without:.2g}"
        )
    chosen = {"diffraction": decision.selected}
    renderer = replace(renderer, **chosen)
    decisions.append(decision)
    if decision.selected != "none":
        decision = _wider_window(truth, renderer, tolerance)
        renderer = replace(renderer, size=int(decision.selected))
        decisions.append(decision)
        functions = truth.functions(renderer.size, distortion)
    few = slice(0, 8)
    part = truth.pixels[0][few], truth.pixels[1][few]
    decision = _sampling(double, part, functions[few], renderer, tolerance)
    renderer = replace(renderer, pupil_samples=int(decision.selected))
    decisions.append(decision)
    decision = _precision((single, double), part, renderer, tolerance)
    decisions.append(decision)
    dtype = torch.float32 if decision.selected == "single" else torch.float64
    return Plan(renderer, dtype, tuple(decisions), without)


def union(plans: Mapping[str, Plan], sensor: Sensor) -> Plan:
    """The plan for windows of a sensor that is as demanding as the most demanding window's.

    Args:
        plans: by the windows' names, all centred on chief rays.
        sensor: the whole one.
    """
    parts = [found.renderer for found in plans.values()]
    renderer = PsfRenderer(
        sensor,
        (max(part.fields[0] for part in parts), max(part.fields[1] for part in parts)),
        max(part.pupil_samples for part in parts),
        max(part.size for part in parts),
        illumination="map" if any(p.illumination == "map" for p in parts) else "functions",
        colours="each" if any(p.colours == "each" for p in parts) else "one",
        diffraction=max((part.diffraction for part in parts), key=_DIFFRACTION_MODELS.index),
    )
    chosen = (
        f"{renderer.fields[0]}×{renderer.fields[1]} fields, {renderer.pupil_samples}² rays, "
        f"{renderer.size} pixels, colours {renderer.colours}, diffraction {renderer.diffraction}"
    )
    error = max(found.expected_error for found in plans.values())
    decision = Decision("windows", chosen, error, f"the most demanding of {', '.join(plans)}")
    double = any(found.dtype == torch.float64 for found in plans.values())
    return Plan(
        renderer,
        torch.float64 if double else torch.float32,
        (decision,),
        max(found.without_diffraction for found in plans.values()),
    )


def _shared_depths(functions: Tensor, scene: Scene, tolerance: float) -> Decision:
    middle = functions[:, scene.depths.index(scene.middle_depth)][:, None]
    return _sharing("depths", functions - middle, len(scene.depths), tolerance)


def _shared_colours(functions: Tensor, scene: Scene, tolerance: float) -> Decision:
    middle = functions[:, :, scene.wavelengths.index(scene.middle_wavelength)][:, :, None]
    return _sharing("colours", functions - middle, len(scene.wavelengths), tolerance)


def _sharing(what: str, difference: Tensor, count: int, tolerance: float) -> Decision:
    error = float(grey_levels(difference).square().mean().sqrt())
    if count == 1:
        return Decision(what, "each", 0.0, "there is one")
    if error <= tolerance:
        return Decision(what, "one", error, "they hardly differ")
    return Decision(what, "each", 0.0, f"one for all would cost {error:.2g}")


def _diffraction(
    functions: Tensor, truth: Survey, renderer: PsfRenderer, tolerance: float
) -> tuple[Decision, float]:
    """Choose the model of diffraction, and return the error of leaving diffraction out.

    A perfect pupil's says whether it can matter at all; where it can, wavefronts are asked.
    """
    scene, pitch = truth.imaging.scene, renderer.sensor.pixel_pitch
    airy = 1.22 * max(scene.wavelengths) * 1e-6 * truth.f_number / pitch
    seen = f"the Airy disc's radius is {airy:.2g} pixels"
    side = max(128, functions.shape[-1] + 1)
    errors = [
        blurred_grey_levels(
            functions[:, :, channel],
            diffraction_transfer(side, side, pitch, wavelength, truth.f_number),
        )
        for channel, wavelength in enumerate(scene.wavelengths)
    ]
    error = float(torch.stack(errors).square().mean().sqrt())
    element = bool(truth.imaging.system.diffractive)
    if error <= _DIFFRACTION * tolerance and not element:
        return Decision("diffraction", "none", error, seen), error
    if element:
        seen = f"{seen}; a diffractive element has other orders than rays'"
    sensor, distortion = renderer.sensor, renderer.registration == "chief_rays"
    # From the middle to a corner: what diffracts there may be beyond Fourier transforms.
    share = torch.linspace(0.5, 1.0, _WAVES, dtype=torch.float64)
    places = share * (sensor.height - 1), share * (sensor.width - 1)
    found, again = (survey(truth.imaging, places, SAMPLES, seed) for seed in (0, 1))
    # As wide as diffraction spreads light, within reason.
    size = renderer.size + 2 * min(math.ceil(8.0 * airy) + 2, _MARGINS[-1])
    samples, against = found.wave_cost(size, distortion)
    pupils = math.prod(renderer.fields) * len(scene.depths) * len(scene.wavelengths)
    if against is None and pupils * samples**2 > _MOST_SAMPLES:
        against = f"{pupils} pupils of {samples}² samples are too many"
    if against is not None:
        # A perfect pupil's effect is then all that is known of it, and its size.
        because = f"{seen}; not by waves: {against}"
        kind = "orders" if element and has_orders(truth.imaging.system) else "limit"
        return Decision("diffraction", kind, error, because), error
    waves = found.waves(size, distortion)
    pair = [s.functions(size, distortion).double() for s in (found, again)]
    rays, differing = 0.5 * (pair[0] + pair[1]), 0.5 * (pair[0] - pair[1])
    limited = with_diffraction_limit(rays, pitch, scene.wavelengths, truth.f_number)
    # Wavefronts have no noise of sampling: that of the rays is not diffraction.
    noise = float(grey_levels(differing).square().mean())
    without, with_limit = (
        math.sqrt(max(float(grey_levels(f - waves).square().mean()) - noise, 0.0))
        for f in (rays, limited)
    )
    if without <= _DIFFRACTION * tolerance:
        return Decision("diffraction", "none", without, f"{seen}; measured by waves"), without
    if with_limit <= _DIFFRACTION * tolerance and not element:
        because = f"{seen}; measured by waves; without it {without:.2g}"
        return Decision("diffraction", "limit", with_limit, because), without
    because = f"{seen}; without it {without:.2g}, with a perfect pupil's {with_limit:.2g}"
    if element and has_orders(truth.imaging.system):
        by_orders = with_diffraction_limit(
            found.orders(size, distortion).double(), pitch, scene.wavelengths, truth.f_number
        )
        # One sample of the pupil has twice the noise of two.
        square = float(grey_levels(by_orders - waves).square().mean()) - 2.0 * noise
        with_orders = math.sqrt(max(square, 0.0))
        if with_orders <= _DIFFRACTION * tolerance:
            return Decision("diffraction", "orders", with_orders, because), without
        because = f"{because}, with all orders {with_orders:.2g}"
    return Decision("diffraction", "wave", 0.0, because), without


def _wider_window(truth: Survey, renderer: PsfRenderer, tolerance: float) -> Decision:
    """A window that holds what diffraction spreads."""
    scene = truth.imaging.scene
    pitch, distortion = renderer.sensor.pixel_pitch, renderer.registration == "chief_rays"

    def blurred(size: int) -> Tensor:
        functions = truth.functions(size, distortion)[:4].double()
        return with_diffraction_limit(functions, pitch, scene.wavelengths, truth.f_number)

    widest = renderer.size + 2 * _MARGINS[-1]
    if truth.imaging.system.diffractive:
        because = "haze of a diffractive element's other orders is even within it"
        return Decision("window with diffraction", str(widest), 0.0, because)
    whole, error, size = blurred(widest), math.inf, renderer.size
    for margin in _MARGINS[:-1]:
        size = renderer.size + 2 * margin
        edge = (widest - size) // 2
        difference = torch.nn.functional.pad(blurred(size), (edge,) * 4) - whole
        error = float(grey_levels(difference).square().mean().sqrt())
        if error <= WINDOW_SHARE * tolerance:
            break
    return Decision("window with diffraction", str(size), error, "the Airy disc is wide")


def _sampling(
    imaging: ImagingSystem,
    places: Pixels,
    functions: Tensor,
    renderer: PsfRenderer,
    tolerance: float,
) -> Decision:
    """The fewest rays whose functions are those of many."""
    distortion = renderer.registration == "chief_rays"
    error, samples = math.inf, _PUPIL_SAMPLES[-1]
    for samples in _PUPIL_SAMPLES:
        found = survey(imaging, places, samples, seed=1)
        coarse = found.functions(renderer.size, distortion)
        error = float(grey_levels(coarse - functions).square().mean().sqrt())
        if error <= _SAMPLING * tolerance:
            break
    because = "the fewest whose noise is small" if error <= _SAMPLING * tolerance else "the most"
    return Decision("pupil samples", str(samples), error, because)


def _precision(
    imaging: Sequence[ImagingSystem],
    places: Pixels,
    renderer: PsfRenderer,
    tolerance: float,
) -> Decision:
    distortion = renderer.registration == "chief_rays"
    found = [survey(each, places, 16).functions(renderer.size, distortion) for each in imaging]
    error = float(grey_levels(found[0].double() - found[1]).square().mean().sqrt())
    if error <= _PRECISION * tolerance:
        return Decision("precision", "single", error, "rounding does not show")
    return Decision("precision", "double", 0.0, f"single would cost {error:.2g}")
