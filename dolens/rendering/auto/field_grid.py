"""The grid of point spread functions that a sensor needs, and their centres."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from dolens.errors import InputError
from dolens.rendering.auto.costs import psf_cost
from dolens.rendering.auto.probes import MEAN, grey_levels
from dolens.rendering.auto.survey import Survey, survey
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.patches import node_positions, triangle_weights
from dolens.rendering.psf_renderer import PsfRenderer

# Strata of the pupil along each side, for functions that are compared.
SAMPLES = 48
# The share of the tolerance that interpolation between fields, and light beyond windows, may take.
FIELDS_SHARE, WINDOW_SHARE = 0.6, 0.25
REGISTRATIONS = ("pinhole", "chief_rays")
_GRIDS = (1, 2, 3, 4, 5, 7, 9, 13, 17, 25)
_LARGEST = 511  # window, pixels


@dataclass(frozen=True)
class Decision:
    """One decision of a plan.

    Attributes:
        topic: the setting that was decided on.
        selected: its value.
        error: the error that it leaves, grey levels on the probe.
        reason: the reason.
    """

    topic: str
    selected: str
    error: float
    reason: str

    def __str__(self) -> str:
        return f"{self.topic}: {self.selected} ({self.error:.2g} grey levels; {self.reason})"


@dataclass(frozen=True)
class Layout:
    """A renderer with its fields, registration, illumination and window, and why these."""

    renderer: PsfRenderer
    decision: Decision


def choose_fields(
    truth: Survey, tolerance: float, registrations: Sequence[str] = REGISTRATIONS
) -> Layout:
    """Choose the cheapest grid whose interpolated functions are those of the points in between.

    Args:
        truth: the points in between.
        tolerance: RMS grey levels on the probe.
        registrations: that may be chosen, of `PsfRenderer`.

    Raises:
        InputError: functions are too wide for any window.
    """
    imaging = truth.imaging
    surfaces = len(imaging.system.surfaces)
    candidates = sorted(
        _candidates(truth, tolerance, registrations),
        key=lambda r: psf_cost(r, imaging.scene, surfaces),
    )
    if not candidates:
        raise InputError(
            f"renderer auto: point spread functions are wider than {_LARGEST} pixels; "
            "give larger pixels, or renderer=rays"
        )
    nodes: dict[tuple[int, int], Survey] = {}
    best: tuple[float, PsfRenderer] | None = None
    for renderer in candidates:
        if renderer.fields not in nodes:
            nodes[renderer.fields] = _node_survey(imaging, renderer)
        error = _interpolation_error(renderer, truth, nodes[renderer.fields])
        if best is None or error < best[0]:
            best = error, renderer
        if error <= FIELDS_SHARE * tolerance:
            break
    assert best is not None  # there is a candidate
    error, renderer = best
    well = error <= FIELDS_SHARE * tolerance
    why = "the least that interpolates well" if well else "the best there is"
    chosen = (
        f"{renderer.fields[0]}×{renderer.fields[1]}, registration {renderer.registration}, "
        f"illumination in {'a map' if renderer.illumination == 'map' else 'the functions'}, "
        f"{renderer.size} pixels"
    )
    return Layout(renderer, Decision("fields", chosen, error, why))


def _candidates(
    truth: Survey, tolerance: float, registrations: Sequence[str]
) -> Iterator[PsfRenderer]:
    sensor = truth.imaging.sensor
    longer = max(sensor.height, sensor.width)
    for registration in registrations:
        distortion = registration == "chief_rays"
        if distortion and truth.chief is None:
            continue
        size = _window(truth, distortion, WINDOW_SHARE * tolerance)
        if size is None:
            continue
        for count in _GRIDS:
            rows, columns = (
                1 if count == 1 else max(2, math.ceil(count * side / longer))
                for side in (sensor.height, sensor.width)
            )
            if count > 1 and (rows > sensor.height // 4 or columns > sensor.width // 4):
                continue
            for illumination in ("functions", "map"):
                yield PsfRenderer(
                    sensor,
                    (rows, columns),
                    size=size,
                    registration="chief_rays" if distortion else "pinhole",
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


def window_decision(truth: Survey, size: int, distortion: bool) -> Decision:
    """Return the error of leaving out the light beyond a window of `size` pixels."""
    error = 255.0 * MEAN * _lost(truth, distortion, size)
    return Decision("window", f"{size} pixels", error, "light beyond it is lost")


def _node_survey(imaging: ImagingSystem, renderer: PsfRenderer) -> Survey:
    sensor = imaging.sensor
    down, across = (
        torch.tensor(node_positions(side, count), dtype=torch.float64)
        for side, count in zip((sensor.height, sensor.width), renderer.fields, strict=True)
    )
    rows, columns = torch.meshgrid(down, across, indexing="ij")
    return survey(imaging, (rows.reshape(-1), columns.reshape(-1)), SAMPLES)


def _interpolation_error(renderer: PsfRenderer, truth: Survey, nodes: Survey) -> float:
    """RMS over the points of the error of functions interpolated from the nodes, grey levels."""
    distortion = renderer.registration == "chief_rays"
    if distortion and nodes.chief is None:
        return math.inf
    sensor, (rows, columns) = truth.imaging.sensor, truth.pixels
    functions, wanted = (s.functions(renderer.size, distortion) for s in (nodes, truth))
    if renderer.illumination == "map":
        light = nodes.light()[..., None, None]
        functions = functions / light.clamp(min=torch.finfo(light.dtype).tiny)
    weights = torch.einsum(
        "nr,nc->nrc",
        triangle_weights(rows, sensor.height, renderer.fields[0]),
        triangle_weights(columns, sensor.width, renderer.fields[1]),
    ).flatten(1)
    found = torch.einsum("nm,mdcij->ndcij", weights.to(functions), functions)
    if renderer.illumination == "map":
        found = found * truth.light()[..., None, None]
    return float(grey_levels(found - wanted).square().mean().sqrt())
