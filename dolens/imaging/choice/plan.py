"""What a scene needs of a renderer, found from a few probe rays, in grey levels."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.choice.cost import psf_cost
from dolens.imaging.choice.probe import (
    MEAN,
    blurred_grey_levels,
    grey_levels,
)
from dolens.imaging.choice.survey import Survey, spread_pixels, survey
from dolens.imaging.diffraction_limit import diffraction_transfer, with_diffraction_limit
from dolens.imaging.patch_convolution import node_positions
from dolens.imaging.psf_renderer import PsfRenderer
from dolens.imaging.scene import PlanarScene
from dolens.imaging.sensor import Sensor
from dolens.optics.system import OpticalSystem

# Points of the sensor where functions are compared, and strata of the pupil along each side there.
_POINTS, _SAMPLES = 24, 48
_GRIDS = (1, 2, 3, 4, 5, 7, 9, 13, 17, 25)
_PUPIL_SAMPLES = (6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64)
# The share of the tolerance that each simplification may take; their squares add up to less than 1.
_FIELDS, _SAMPLING, _WINDOW, _SHARING, _DIFFRACTION, _PRECISION = 0.6, 0.5, 0.25, 0.25, 0.3, 0.1
# Pixels by which windows grow, for diffraction; the last is for comparison.
_MARGINS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64)
# Light that a window leaves out lies far from the centre; the largest window, pixels.
_LARGEST = 511


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


@dataclass(frozen=True)
class Plan:
    """A renderer by point spread functions, what it is expected to err by, and why.

    Attributes:
        renderer: the settings.
        dtype: precision of rays and image.
        findings: the decisions.
        without_diffraction: grey levels that leaving diffraction out costs, or would cost.
    """

    renderer: PsfRenderer
    dtype: torch.dtype
    findings: tuple[Finding, ...]
    without_diffraction: float

    @property
    def expected_error(self) -> float:
        """Grey levels, as if the decisions' errors were independent."""
        return math.sqrt(sum(finding.error**2 for finding in self.findings))


@torch.no_grad()
def plan(
    system: OpticalSystem,
    precise: OpticalSystem,
    scene: PlanarScene,
    sensor: Sensor,
    tolerance: float,
    backend: str,
) -> Plan:
    """Choose fields, registration, window, pupil samples, what is shared, diffraction, precision.

    Args:
        system: the lens in single precision.
        precise: the same in double precision.
        scene: depths and wavelengths.
        sensor: the pixels.
        tolerance: RMS grey levels (1/255 of full scale, linear light) on the probe.
        backend: what traces.

    Raises:
        InputError: functions are too wide for any window.
    """
    rows, columns = spread_pixels(sensor, _POINTS)
    truth = survey(precise, scene, sensor, rows, columns, _SAMPLES, backend)
    layout = _fields(precise, scene, sensor, rows, columns, truth, tolerance, backend)
    renderer, distortion = layout.renderer, layout.renderer.registration == "chief_rays"
    functions = truth.functions(renderer.size, distortion)
    findings = [layout.finding, _window_finding(truth, renderer.size, distortion)]
    for name, finding in (
        ("depths", _shared_depths(functions, scene, tolerance)),
        ("colours", _shared_colours(functions, scene, tolerance)),
    ):
        renderer = replace(renderer, **{name: finding.chosen})
        findings.append(finding)
    finding, without = _diffraction(functions, truth, scene, sensor, tolerance)
    renderer = replace(renderer, diffraction=finding.chosen)
    findings.append(finding)
    if finding.chosen == "limit":
        finding = _wider_window(truth, scene, renderer, tolerance)
        renderer = replace(renderer, size=int(finding.chosen))
        findings.append(finding)
        functions = truth.functions(renderer.size, distortion)
    few = slice(0, 8)
    part = rows[few], columns[few]
    finding = _sampling(precise, scene, sensor, part, functions[few], renderer, tolerance, backend)
    renderer = replace(renderer, pupil_samples=int(finding.chosen))
    findings.append(finding)
    finding = _precision(system, precise, scene, sensor, part, renderer, tolerance, backend)
    findings.append(finding)
    dtype = torch.float32 if finding.chosen == "single" else torch.float64
    return Plan(renderer, dtype, tuple(findings), without)


@dataclass(frozen=True)
class _Layout:
    renderer: PsfRenderer
    finding: Finding


def _fields(
    system: OpticalSystem,
    scene: PlanarScene,
    sensor: Sensor,
    rows: Tensor,
    columns: Tensor,
    truth: Survey,
    tolerance: float,
    backend: str,
) -> _Layout:
    """The cheapest grid whose interpolated functions are those of the points in between."""
    surfaces = len(system.surfaces)
    candidates = sorted(
        _candidates(truth, sensor, tolerance), key=lambda r: psf_cost(r, scene, surfaces)
    )
    if not candidates:
        raise InputError(
            f"renderer auto: point spread functions are wider than {_LARGEST} pixels; "
            "use renderer=rays"
        )
    nodes: dict[tuple[int, int], Survey] = {}
    best: tuple[float, PsfRenderer] | None = None
    for renderer in candidates:
        if renderer.fields not in nodes:
            nodes[renderer.fields] = _node_survey(system, scene, sensor, renderer, backend)
        error = _interpolation_error(renderer, sensor, rows, columns, truth, nodes[renderer.fields])
        if best is None or error < best[0]:
            best = error, renderer
        if error <= _FIELDS * tolerance:
            break
    error, renderer = best
    why = (
        "the least that interpolates well" if error <= _FIELDS * tolerance else "the best there is"
    )
    chosen = (
        f"{renderer.fields[0]}×{renderer.fields[1]}, registration {renderer.registration}, "
        f"illumination in {'a map' if renderer.illumination == 'map' else 'the functions'}, "
        f"{renderer.size} pixels"
    )
    return _Layout(renderer, Finding("fields", chosen, error, why))


def _candidates(truth: Survey, sensor: Sensor, tolerance: float) -> Iterator[PsfRenderer]:
    longer = max(sensor.height, sensor.width)
    for registration in ("pinhole", "chief_rays"):
        distortion = registration == "chief_rays"
        if distortion and truth.chief is None:
            continue
        size = _window(truth, distortion, _WINDOW * tolerance)
        if size is None:
            continue
        for count in _GRIDS:
            fields = tuple(
                1 if count == 1 else max(2, math.ceil(count * side / longer))
                for side in (sensor.height, sensor.width)
            )
            if count > 1 and (fields[0] > sensor.height // 4 or fields[1] > sensor.width // 4):
                continue
            for illumination in ("functions", "map"):
                yield PsfRenderer(
                    sensor,
                    fields,
                    size=size,
                    registration=registration,
                    illumination=illumination,
                )


def _lost(truth: Survey, distortion: bool, size: int) -> float:
    """The mean share of light beyond a window."""
    seen = truth.offsets(distortion)
    # A ray's spline reaches a pixel and a half.
    far = torch.maximum(seen.rows.abs(), seen.columns.abs()) > size / 2 - 1.5
    light = seen.weight.expand(far.shape)
    return float((light * far).sum() / light.sum())


def _window(truth: Survey, distortion: bool, tolerance: float) -> int | None:
    """The smallest window that leaves out no more than `tolerance` grey levels of mean light."""
    share = tolerance / (255.0 * MEAN)
    low, high = 2, (_LARGEST - 1) // 2
    if _lost(truth, distortion, 2 * high + 1) > share:
        return None
    while low < high:
        middle = (low + high) // 2
        if _lost(truth, distortion, 2 * middle + 1) <= share:
            high = middle
        else:
            low = middle + 1
    return 2 * high + 1


def _window_finding(truth: Survey, size: int, distortion: bool) -> Finding:
    error = 255.0 * MEAN * _lost(truth, distortion, size)
    return Finding("window", f"{size} pixels", error, "light beyond it is lost")


def _node_survey(
    system: OpticalSystem, scene: PlanarScene, sensor: Sensor, renderer: PsfRenderer, backend: str
) -> Survey:
    down, across = (
        torch.tensor(node_positions(side, count), dtype=torch.float64)
        for side, count in zip((sensor.height, sensor.width), renderer.fields, strict=True)
    )
    rows, columns = torch.meshgrid(down, across, indexing="ij")
    return survey(system, scene, sensor, rows.reshape(-1), columns.reshape(-1), _SAMPLES, backend)


def _interpolation_error(
    renderer: PsfRenderer,
    sensor: Sensor,
    rows: Tensor,
    columns: Tensor,
    truth: Survey,
    nodes: Survey,
) -> float:
    """RMS over the points of the error of functions interpolated from the nodes, grey levels."""
    distortion = renderer.registration == "chief_rays"
    if distortion and nodes.chief is None:
        return math.inf
    functions, wanted = (s.functions(renderer.size, distortion) for s in (nodes, truth))
    if renderer.illumination == "map":
        light = nodes.light()[..., None, None]
        functions = functions / light.clamp(min=torch.finfo(light.dtype).tiny)
    weights = torch.einsum(
        "nr,nc->nrc",
        _hats(rows, sensor.height, renderer.fields[0]),
        _hats(columns, sensor.width, renderer.fields[1]),
    ).flatten(1)
    found = torch.einsum("nm,mdcij->ndcij", weights.to(functions), functions)
    if renderer.illumination == "map":
        found = found * truth.light()[..., None, None]
    return float(grey_levels(found - wanted).square().mean().sqrt())


def _hats(places: Tensor, length: int, count: int) -> Tensor:
    """(N, count): bilinear weights of nodes at places along a side."""
    if count == 1:
        return torch.ones(len(places), 1, dtype=places.dtype)
    spacing = (length - 1) / (count - 1)
    node = torch.arange(count, dtype=places.dtype) * spacing
    return (1.0 - (places[:, None] - node).abs() / spacing).clamp(min=0.0)


def _shared_depths(functions: Tensor, scene: PlanarScene, tolerance: float) -> Finding:
    middle = functions[:, scene.depths.index(scene.middle_depth)][:, None]
    return _sharing("depths", functions - middle, len(scene.depths), tolerance)


def _shared_colours(functions: Tensor, scene: PlanarScene, tolerance: float) -> Finding:
    middle = functions[:, :, scene.wavelengths.index(scene.middle_wavelength)][:, :, None]
    return _sharing("colours", functions - middle, len(scene.wavelengths), tolerance)


def _sharing(what: str, difference: Tensor, count: int, tolerance: float) -> Finding:
    error = float(grey_levels(difference).square().mean().sqrt())
    if count == 1:
        return Finding(what, "each", 0.0, "there is one")
    if error <= _SHARING * tolerance:
        return Finding(what, "one", error, "they hardly differ")
    return Finding(what, "each", 0.0, f"one for all would cost {error:.2g}")


def _diffraction(
    functions: Tensor, truth: Survey, scene: PlanarScene, sensor: Sensor, tolerance: float
) -> tuple[Finding, float]:
    """Whether the blur of the pupil's edge shows behind that of the rays, and by how much."""
    airy = 1.22 * max(scene.wavelengths) * 1e-6 * truth.f_number / sensor.pixel_pitch
    side = max(128, functions.shape[-1] + 1)
    errors = [
        blurred_grey_levels(
            functions[:, :, channel],
            diffraction_transfer(side, side, sensor.pixel_pitch, wavelength, truth.f_number),
        )
        for channel, wavelength in enumerate(scene.wavelengths)
    ]
    error = float(torch.stack(errors).square().mean().sqrt())
    seen = f"the Airy disc's radius is {airy:.2g} pixels"
    if error <= _DIFFRACTION * tolerance:
        return Finding("diffraction", "none", error, seen), error
    return Finding("diffraction", "limit", 0.0, f"{seen}; without it {error:.2g}"), error


def _wider_window(
    truth: Survey, scene: PlanarScene, renderer: PsfRenderer, tolerance: float
) -> Finding:
    """A window that holds what diffraction spreads."""
    pitch, distortion = renderer.sensor.pixel_pitch, renderer.registration == "chief_rays"

    def blurred(size: int) -> Tensor:
        functions = truth.functions(size, distortion)[:4].double()
        return with_diffraction_limit(functions, pitch, scene.wavelengths, truth.f_number)

    widest = renderer.size + 2 * _MARGINS[-1]
    whole, error, size = blurred(widest), math.inf, renderer.size
    for margin in _MARGINS[:-1]:
        size = renderer.size + 2 * margin
        edge = (widest - size) // 2
        difference = torch.nn.functional.pad(blurred(size), (edge,) * 4) - whole
        error = float(grey_levels(difference).square().mean().sqrt())
        if error <= _WINDOW * tolerance:
            break
    return Finding("window with diffraction", str(size), error, "the Airy disc is wide")


def _sampling(
    system: OpticalSystem,
    scene: PlanarScene,
    sensor: Sensor,
    places: tuple[Tensor, Tensor],
    functions: Tensor,
    renderer: PsfRenderer,
    tolerance: float,
    backend: str,
) -> Finding:
    """The fewest rays whose functions are those of many."""
    distortion = renderer.registration == "chief_rays"
    error, samples = math.inf, _PUPIL_SAMPLES[-1]
    for samples in _PUPIL_SAMPLES:
        found = survey(system, scene, sensor, *places, samples, backend, seed=1)
        coarse = found.functions(renderer.size, distortion)
        error = float(grey_levels(coarse - functions).square().mean().sqrt())
        if error <= _SAMPLING * tolerance:
            break
    because = "the fewest whose noise is small" if error <= _SAMPLING * tolerance else "the most"
    return Finding("pupil samples", str(samples), error, because)


def _precision(
    system: OpticalSystem,
    precise: OpticalSystem,
    scene: PlanarScene,
    sensor: Sensor,
    places: tuple[Tensor, Tensor],
    renderer: PsfRenderer,
    tolerance: float,
    backend: str,
) -> Finding:
    distortion = renderer.registration == "chief_rays"
    found = [
        survey(lens, scene, sensor, *places, 16, backend).functions(renderer.size, distortion)
        for lens in (system, precise)
    ]
    error = float(grey_levels(found[0].double() - found[1]).square().mean().sqrt())
    if error <= _PRECISION * tolerance:
        return Finding("precision", "single", error, "rounding does not show")
    return Finding("precision", "double", 0.0, f"single would cost {error:.2g}")
