"""The lens of a recorded step: its section with rays, its spots, and its variables at their bounds.

All is plain data for a page, computed from the numbers of the run folder.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError, one_line
from dolens.experiments.running.run_files import RESOLVED, read_settings
from dolens.experiments.watch.history import Frame, History, Values
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import to_file_units
from dolens.optimize import MeritSettings
from dolens.optimize.rounds import spot_labels
from dolens.plotting.layout import layout_drawing
from dolens.plotting.lens_section import section_angles
from dolens.plotting.section import drawn_surfaces, glass_sections, sensor_curve, stop_bars
from dolens.plotting.style import ordered_colours, spectral_colour
from dolens.prescriptions import lens_from_prescription, load_lens

# Rays of each field in a section, and points of each spot.
_RAYS, _POINTS = 5, 160
_DIGITS = 5
# Of the points of a profile, the first and the last among them.
_EVERY = 5
_AT_BOUND = 1e-9
Line = list[list[float]]


@dataclass
class LensFrames:
    """The lens of a run at its recorded steps.

    Attributes:
        initial: where the run began.
        settings: of the spots: those of a design's merit, else those of the lens.
        first_rays: whether the rays that pass the initial lens serve all rounds.
    """

    initial: Lens
    settings: MeritSettings
    first_rays: bool

    @staticmethod
    def of(run: Path) -> "LensFrames":
        """Read the lens and the merit of a run folder.

        Raises:
            InputError: there is no lens, or a file is damaged.
        """
        lens = load_lens(run / "lens" / "initial.yaml", dtype=torch.float64)
        config = read_settings(run / RESOLVED) or {}
        given = config.get("merit")
        settings = MeritSettings()
        if isinstance(given, dict):
            plain = {key: value for key, value in given.items() if key != "_target_"}
            try:
                settings = MeritSettings(**plain)
            except TypeError as error:
                raise InputError(f"{run / RESOLVED}: merit: {one_line(error)}") from None
        settings = replace(settings, quality="spots", quality_options={}, operands=())
        automatic = config.get("semi_diameters") == "automatic" and not config.get("keep_pupils")
        return LensFrames(lens, settings, automatic)

    @torch.no_grad()
    def lens(self, values: Values) -> Lens:
        """Return the lens with some parameters at recorded values.

        Raises:
            InputError: a parameter that the lens does not have, or of another shape.
        """
        lens = self.initial.storing_its_values()
        for name, parameter in lens.variables(list(values)).items():
            found = torch.tensor(values[name], dtype=torch.float64)
            if found.numel() != parameter.numel():
                raise InputError(f"history: {name} has {found.numel()} values")
            parameter.copy_(found.reshape(parameter.shape))
        return lens

    def shown(self, history: History, frame: Frame) -> dict[str, Any]:
        """Return what a page shows of a frame: `section`, `spots` and `variables`.

        What cannot be computed is a text with the reason in its place.
        """
        try:
            lens = self.lens(frame.lens)
        except InputError as problem:
            return dict.fromkeys(("section", "spots"), str(problem)) | {"variables": []}
        return {
            "section": _or_reason(section, lens, self.heights(lens)),
            "spots": _or_reason(self.spots, history, frame, lens) if self.has_spots else None,
            "variables": list(variables(history, frame)),
        }

    @property
    def has_spots(self) -> bool:
        """Return whether fields are known, as of a design."""
        return self.settings.fields is not None or self.initial.fields is not None

    def heights(self, lens: Lens) -> list[float]:
        """Return the heights along y of the fields in the section."""
        try:
            points = self.settings.conditions_of(lens).fields.tolist()
        except InputError:
            points = [(0.0, 0.0)]
        return list(dict.fromkeys(y for x, y in points if x == 0.0)) or [0.0]

    def spots(self, history: History, frame: Frame, lens: Lens) -> dict[str, Any]:
        """Return the spots of a frame, over the rays of its round, as the run's own numbers are.

        Returns:
            `spots`: for each field and wavelength its label, RMS radius (µm), colour, and points
            (µm) about its reference.

        Raises:
            InputError: the lens has no fields, or no rays.
        """
        began = [entry for entry in history.rounds if entry.step < frame.step or entry.step == 0]
        of_rays = self.initial
        if began and not self.first_rays:
            of_rays = self.lens(began[-1].lens)
        states = list(self.settings.states_of(lens))
        found = []
        for state in states or [None]:
            quality = self.settings.image_quality(of_rays.in_state(state))
            assert quality is not None  # spots are
            values = quality.values(lens.in_state(state))
            for number, label in enumerate(spot_labels(quality.spots)):
                mine = (quality.spots.spot == number) & (quality.spots.weight > 0.0)
                points = 1e3 * values.deviations[mine]
                rms = 1e3 * float(values.rms[number])
                field, _, wave = label.partition("/")
                found.append(
                    {
                        "field": field if state is None else f"{state} {field}",
                        "wavelength": wave,
                        "colour": spectral_colour(float(quality.spots.wavelengths[number])),
                        "rms": rms if math.isfinite(rms) else None,
                        "points": _few(points, quality.spots.centred[number]),
                    }
                )
        return {"spots": found}


def _few(points: Tensor, centred: Tensor) -> Line:
    """Return some of many points (N, 2), with the mirror images that they stand for."""
    every = max(1, math.ceil(len(points) / _POINTS))
    points = points[::every]
    for axis in (0, 1):
        if bool(centred[axis]):
            mirrored = points.clone()
            mirrored[:, axis] *= -1.0
            points = torch.cat([points, mirrored])
    return _rounded(points.cpu().numpy())


def variables(history: History, frame: Frame) -> Iterator[dict[str, Any]]:
    """Yield the variables of a frame with their bounds, in the units of files."""
    for label, (low, high, unit) in history.bounds.items():
        name, _, place = label.partition("[")
        value = frame.lens.get(name)
        if isinstance(value, list):
            number = place.rstrip("]")
            inside = number.isdecimal() and int(number) < len(value)
            value = value[int(number)] if inside else None
        if value is None:
            continue
        here = to_file_units(name, value)
        ends = [end for end in (low, high) if end is not None]
        at = any(abs(here - end) <= _AT_BOUND * max(abs(end), 1e-12) for end in ends)
        yield {"label": label, "value": here, "low": low, "high": high, "unit": unit, "at": at}


@torch.no_grad()
def section(lens: Lens, heights: Sequence[float]) -> dict[str, Any]:
    """Return the section of a lens: lines of z and y, mm, and the colours of its fields' rays.

    Args:
        lens: the lens.
        heights: of the fields along y, degrees or mm.

    Raises:
        InputError: it cannot be drawn; see `dolens.plotting.layout_figure`.
    """
    distance = lens.object_distance
    angles = section_angles(lens, heights, lens.primary_wavelength, distance)
    drawing = layout_drawing(lens, lens.primary_wavelength, angles, _RAYS, distance)
    colours = ordered_colours(len(heights))
    profiles = [(z[::_EVERY], y[::_EVERY]) for z, y in drawing.profiles]
    system = drawing.system
    bars = stop_bars(system, profiles[system.stop - 1], 0.2 * drawing.height)
    z, half = drawing.z_limits, drawing.half_height
    return {
        "box": [z[0], -half, z[1] - z[0], 2.0 * half],
        "glass": [_rounded(glass.outline) for glass in glass_sections(system, profiles)],
        "surfaces": [
            _rounded(np.stack(profiles[number - 1], -1))
            for number in drawn_surfaces(system, profiles)
        ],
        "stop": [_rounded(bar) for bar in bars],
        "sensor": _rounded(sensor_curve(system, drawing.sensor)),
        "fields": [
            {
                "label": f"{height:g}{'°' if distance is None else ' mm'}",
                "colour": colour,
                "rays": [_rounded(path[:, [2, 1]]) for path in fan.paths],
            }
            for height, colour, fan in zip(heights, colours, drawing.fans, strict=True)
        ],
    }


def form_section(prescription: Mapping[str, Any]) -> dict[str, Any] | str:
    """Return the section of a form of a search, or why there is none."""
    try:
        lens = lens_from_prescription(dict(prescription), torch.float64, where="history: form")
        frames = LensFrames(lens, MeritSettings(), False)
    except InputError as problem:
        return str(problem)
    return _or_reason(section, lens, frames.heights(lens))


def _or_reason(make: Any, *arguments: Any) -> Any:
    """Return what a function makes, or the reason in words: a page shows either."""
    try:
        return make(*arguments)
    except InputError as problem:
        return str(problem)
    except (RuntimeError, ArithmeticError, ValueError, IndexError) as problem:
        return one_line(f"cannot be computed ({type(problem).__name__}: {problem})")[:300]


def _rounded(points: np.ndarray) -> Line:
    """Return points as lists, to so many significant digits; those that are none are left out."""
    points = points[np.isfinite(points).all(-1)]
    return [[float(f"{value:.{_DIGITS}g}") for value in point] for point in points.tolist()]
