"""Time, memory and error of whole renders and of point spread functions."""

import gc
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from dolens.errors import InputError, check_keys
from dolens.experiments.settings import check_finite, check_sensor_distance, numbers_of
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import to_lens_units
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.field_grid import spread_pixels, survey
from dolens.rendering.auto.probes import Reference, grey_levels, probe_image, reference
from dolens.rendering.gradient_check import (
    Agreement,
    Render,
    agreement,
    gradient,
    gradients_of_rays,
    image_measure,
    reference_strata,
)
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.protocol import Renderer
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor
from dolens.typed_values import call_with_settings, check_type

# Renders by more rays than these are timed on a window, and that multiplied.
_MANY, _WINDOW, _MARGIN = 128, 64, 48
# Pixels along each side of functions, where no plan says how many are enough.
_PSF_SIZE = 65
_SCENE_KEYS = ("lens", "values", "depths", "wavelengths", "sensor", "variables")


@dataclass(frozen=True)
class Subject:
    """Holds a lens, its scene and its sensor.

    Attributes:
        name: of the scene.
        lens: its precision is the contenders', where they do not choose themselves.
        scene: depths and wavelengths.
        sensor: the pixels.
        variables: names of the parameters that gradients are taken of.
    """

    name: str
    lens: Lens
    scene: PlanarScene
    sensor: Sensor
    variables: tuple[str, ...]

    @classmethod
    def of(cls, name: str, settings: Mapping[str, Any]) -> Self:
        """Return a lens and its scene as a configuration gives them.

        Args:
            name: of the scene.
            settings: `lens` (a prescription), `values` (parameters to change), `depths` (mm),
                `wavelengths` (nm), `sensor`, and `variables`, patterns of what gradients are taken
                of.

        Raises:
            InputError: an unknown key, or a bad value.
        """
        check_keys(settings, _SCENE_KEYS, f"scenes.{name}")
        for key in _SCENE_KEYS:
            if key != "values" and key not in settings:
                raise InputError(f"scenes.{name}.{key}: is missing")
        lens = lens_from_prescription(settings["lens"], torch.float32, where=f"scenes.{name}.lens")
        check_sensor_distance(lens, f"scenes.{name}.lens")
        with torch.no_grad():
            for pattern, value in (settings.get("values") or {}).items():
                check_finite(f"scenes.{name}.values.{pattern}", value)
                for key, parameter in lens.variables([pattern]).items():
                    parameter.fill_(to_lens_units(key, value))
        numbers = {
            k: numbers_of(f"scenes.{name}.{k}", settings[k]) for k in ("depths", "wavelengths")
        }
        scene = PlanarScene(**numbers)
        sensor = call_with_settings(Sensor, settings["sensor"], f"scenes.{name}.sensor")
        check_type(settings["variables"], Sequence[str], f"scenes.{name}.variables")
        try:
            names = tuple(lens.variables(list(settings["variables"])))
        except InputError as error:
            raise InputError(f"scenes.{name}.variables: {error}") from error
        return cls(name, lens.requires_grad_(False), scene, sensor, names)

    def texture(self) -> Tensor:
        """Return a probe image that covers the sensor."""
        sensor = self.sensor
        return probe_image(sensor.height + 2 * _MARGIN, sensor.width + 2 * _MARGIN, seed=3)


@dataclass(frozen=True)
class Contender:
    """Holds a renderer that is compared with others.

    Attributes:
        model: `rays`, `psf` or `auto`, and what tells its kind.
        setting: what tells it from others of its model.
        renderer: for the whole sensor.
        dtype: of the lens.
    """

    model: str
    setting: str
    renderer: Renderer
    dtype: torch.dtype = torch.float32


def render_contenders(
    subject: Subject,
    samples: Sequence[int],
    fields: Sequence[int],
    tolerances: Sequence[float],
) -> list[Contender]:
    """Return renderers by rays, by point spread functions, and by choice for tolerances.

    Args:
        subject: the scene.
        samples: strata along each side of the pupil.
        fields: functions along each side of the sensor.
        tolerances: grey levels.
    """
    sensor, plans = subject.sensor, []
    stored = subject.lens.variables(list(subject.variables))
    values = {n: p.detach().clone().requires_grad_() for n, p in stored.items()}
    for model, diffraction in (("auto", False), ("auto with diffraction", True)):
        for tolerance in tolerances:
            auto = AutoRenderer(sensor, tolerance, diffraction=diffraction)
            auto.make_plan(subject.lens.with_values(values), subject.scene)
            plans.append(Contender(model, f"{model}, {tolerance:g} grey levels", auto))
    found = [Contender("rays", f"{n * n} rays", RayRenderer(sensor, n)) for n in samples]
    sizes = [p.renderer.psf_size for p in plans]
    size = max((size for size in sizes if size is not None), default=_PSF_SIZE)
    for registration in ("pinhole", "chief_rays"):
        for count in fields:
            renderer = PsfRenderer(sensor, (count, count), 32, size, registration)
            label = f"{count}×{count}, {registration.replace('_', ' ')}"
            found.append(Contender(f"psf, {registration.replace('_', ' ')}", label, renderer))
    return found + plans


def render_rows(
    subject: Subject, contenders: Sequence[Contender], reference_samples: int, seconds: float
) -> tuple[list[dict[str, float | str]], Reference]:
    """Return a row for each contender, and the judge of their errors.

    Args:
        subject: the scene.
        contenders: ways of rendering it.
        reference_samples: of the converged image, strata along each side of the pupil.
        seconds: that times of one group of contenders may take.
    """
    texture = subject.texture()
    rays = RayRenderer(subject.sensor, reference_samples)
    judge = reference(rays, subject.lens, subject.scene, texture, seed=1)
    fast = [c for c in contenders if not _is_slow(subject, c)]
    slow = [c for c in contenders if _is_slow(subject, c)]
    times = {}
    for backward in (False, True):
        calls = {c.setting: _call(subject, c, texture, backward) for c in fast}
        times[backward] = by_turns(calls, seconds)
        for contender in slow:
            window, factor = _window(subject)
            part = replace(contender, renderer=contender.renderer.on(window))
            call = _call(subject, part, texture, backward)
            times[backward][contender.setting] = factor * by_turns({"": call}, 0.0, 1)[""]
    rows = []
    for contender in contenders:
        error = judge.error(_image(subject, contender, texture, judge))
        rows.append(
            {
                "scene": subject.name,
                "part": "render",
                "model": contender.model,
                "setting": contender.setting,
                "error_grey_levels": error,
                "error_uncertainty": judge.uncertainty,
                "forward_s": times[False][contender.setting],
                "with_gradient_s": times[True][contender.setting],
                "peak_mb": (
                    float("nan")
                    if _is_slow(subject, contender)
                    else peak_megabytes(_call(subject, contender, texture, True))
                ),
            }
        )
    return rows, judge


def _is_slow(subject: Subject, contender: Contender) -> bool:
    """Return whether it traces many rays for each pixel and wavelength."""
    renderer, sensor = contender.renderer, subject.sensor
    values = sensor.height * sensor.width * len(subject.scene.wavelengths)
    return renderer.monte_carlo and renderer.rays_per_image(subject.scene) > _MANY * values


def _window(subject: Subject) -> tuple[Sensor, float]:
    """Return a window in the middle, and how many times larger the sensor is."""
    sensor = subject.sensor
    height, width = min(_WINDOW, sensor.height), min(_WINDOW, sensor.width)
    top, left = (sensor.height - height) // 2, (sensor.width - width) // 2
    factor = sensor.height * sensor.width / (height * width)
    return sensor.window(top, left, height, width), factor


def _call(
    subject: Subject, contender: Contender, texture: Tensor, backward: bool
) -> Callable[[], Tensor]:
    """Return a call that renders, and differentiates with respect to the subject's variables."""
    stored = {n: p.detach() for n, p in subject.lens.variables(list(subject.variables)).items()}

    def call() -> Tensor:
        values = {n: p.clone().requires_grad_(backward) for n, p in stored.items()}
        image = contender.renderer.render(
            subject.lens.with_values(values), subject.scene, texture, 1
        )
        if backward:
            image.square().mean().backward()
        return image

    return call


def _image(subject: Subject, contender: Contender, texture: Tensor, judge: Reference) -> Tensor:
    """Return the contender's image; with rays, which are many, only the windows that are used."""
    lens, scene = subject.lens, subject.scene
    # As the reference is of rays.
    renderer = contender.renderer.without_diffraction()
    with torch.no_grad():
        if not renderer.monte_carlo:
            return renderer.render(lens, scene, texture, 5)
        sensor = subject.sensor
        shape = (1, len(scene.depths), texture.shape[1], sensor.height, sensor.width)
        image = texture.new_zeros(shape)
        for top, left, height, width in judge.windows:
            window = sensor.window(top, left, height, width)
            part = renderer.on(window).render(lens, scene, texture, 5)
            image[..., top : top + height, left : left + width] = part
        return image


def gradient_agreements(subject: Subject, contenders: Sequence[Contender]) -> dict[str, Agreement]:
    """Compare the contenders' gradients with those of rays, by setting.

    They are gradients of the squared error to a pinhole's image, with respect to the subject's
    variables in units of their magnitudes.

    All without diffraction; of contenders by many rays, which are slow, none is asked.
    """
    lens, scene, sensor = subject.lens, subject.scene, subject.sensor
    texture = subject.texture()
    truth = pinhole_image(texture, sensor)[:, None]
    stored = lens.variables(list(subject.variables))
    values = {n: p.detach().clone().requires_grad_() for n, p in stored.items()}
    measure = image_measure(values, truth)
    side = reference_strata(sensor.height, sensor.width, len(scene.wavelengths))

    def rendered(renderer: Renderer) -> Render:
        def render(values: Mapping[str, Tensor], seed: int) -> Tensor:
            return renderer.render(lens.with_values(values), scene, texture, seed)

        return render

    judge = gradients_of_rays(rendered(RayRenderer(sensor, side)), texture, measure, 101)
    found = {}
    for contender in contenders:
        if _is_slow(subject, contender):
            continue
        render = rendered(contender.renderer.without_diffraction())
        own = gradient(render, texture, measure, (1,))
        found[contender.setting] = agreement(own, judge)
    return found


_POINTS, _TRUE_SAMPLES, _SIZE = 9, 160, 65


@torch.no_grad()
def function_rows(
    subject: Subject, samples: Sequence[int], seconds: float
) -> list[dict[str, float | str]]:
    """Return a row for each number of rays: error in grey levels on the probe, time a function.

    Args:
        subject: the scene.
        samples: strata along each side of the pupil.
        seconds: that timing may take.
    """
    imaging = ImagingSystem.of(subject.lens.system(), subject.scene, subject.sensor)
    places = spread_pixels(subject.sensor, _POINTS)

    def functions(count: int, seed: int) -> torch.Tensor:
        found = survey(imaging, places, count, seed)
        return found.functions(_SIZE, found.chief is not None)

    truth = functions(_TRUE_SAMPLES, 0)
    times = by_turns({str(n): lambda n=n: functions(n, 1) for n in samples}, seconds)
    each = _POINTS * truth.shape[1] * truth.shape[2]
    return [
        {
            "scene": subject.name,
            "part": "psf",
            "model": "psf",
            "setting": f"{n * n} rays",
            "error_grey_levels": float(grey_levels(functions(n, 1) - truth).square().mean().sqrt()),
            "forward_s": times[str(n)] / each,
        }
        for n in samples
    ]


def by_turns(
    calls: Mapping[str, Callable[[], object]], seconds: float, rounds: int = 3
) -> dict[str, float]:
    """Return the median time of each call, s.

    Calls run by turns, so that a phase in which the machine is slow meets all of them, each at
    least `rounds` times and on until `seconds` are spent.  A first turn is not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    began, turn = time.perf_counter(), 0
    while turn < rounds or time.perf_counter() - began < seconds:
        for name, call in calls.items():
            started = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - started)
        turn += 1
    return {name: statistics.median(values) for name, values in times.items()}


def peak_megabytes(call: Callable[[], object]) -> float:
    """Return the peak memory of the CPU tensors of a call, MB.

    Added up from the allocator's own events; what a kernel keeps to itself is not among them.
    """
    gc.collect()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        call()
    held = most = 0
    for event in run.profiler.kineto_results.events():
        if event.name() == "[memory]" and event.device_type() == torch.autograd.DeviceType.CPU:
            held += event.nbytes()
            most = max(most, held)
    return most / 1e6
