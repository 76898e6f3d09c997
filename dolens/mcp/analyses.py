"""Jobs of the server that look at a lens: its numbers, rays and analyses, each with its error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch

from dolens.analysis.conditions import Conditions, conditions, field_scans, spectral_lines
from dolens.analysis.encircled_energy import encircled_energy
from dolens.analysis.field_curves import field_curves
from dolens.analysis.lateral_colour import lateral_colour
from dolens.analysis.modulation_transfer import frequency_range
from dolens.analysis.ray_intercepts import ray_fans
from dolens.analysis.spot_diagram import SpotDiagram, spot_diagram
from dolens.diffraction.illumination import relative_illumination
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.point_spread import diffraction_encircled_energy
from dolens.diffraction.wavefront_map import wavefront_maps
from dolens.errors import InputError
from dolens.lens_page.overview import prepared_lens
from dolens.mcp.answer import Answer, Prescription, plain
from dolens.mcp.pictures import lens_of
from dolens.optics.lens import Lens
from dolens.optics.rays import Status
from dolens.plotting.field_curves import (
    field_curves_figure,
    illumination_figure,
    lateral_colour_figure,
)
from dolens.plotting.lens_section import lens_section_figure
from dolens.plotting.modulation import modulation_comparison_figure
from dolens.plotting.point_spread import encircled_energy_figure
from dolens.plotting.spots_and_ray_fans import ray_fans_figure, spots_figure
from dolens.plotting.wavefront_maps import wavefront_maps_figure
from dolens.prescriptions.plain_values import yaml_of
from dolens.views.overview import title_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RAYS = 2000
_ROUNDING = "real rays in double precision: rounding alone"
# Letters of a prescription that are told.
_LONGEST_TEXT = 200_000
# Numbers of a curve that are told.
_TOLD = 9


def mean_spot(lens: Lens, rays: int = _RAYS) -> tuple[float, float]:
    """Return the mean over the lens's fields of its RMS spot radii, µm, and what it errs by."""
    where = conditions(lens)
    fine, coarse = (spot_diagram(lens, where, n).polychromatic_rms for n in (rays, rays // 2))
    mean = 1e3 * float((fine * where.field_weights).sum())
    return mean, abs(mean - 1e3 * float((coarse * where.field_weights).sum()))


def _fields(where: Conditions) -> list[list[float]]:
    return where.fields.tolist()


def _unit(where: Conditions) -> str:
    return "deg" if where.field_unit == "°" else "mm"


def _about(fine: SpotDiagram, coarse: SpotDiagram) -> tuple[list[dict[str, Any]], float]:
    """Return spots by field, and the most that an RMS radius errs by, µm."""
    where, light = fine.where, fine.weight / fine.weight.sum()
    passed = (light * fine.valid).sum(-1)
    rows = [
        {
            f"field_{_unit(where)}": point,
            "rms_um": 1e3 * fine.polychromatic_rms[n],
            "rms_by_wavelength_um": 1e3 * fine.rms[n],
            "largest_um": 1e3 * fine.geo[n],
            "centroid_mm": fine.polychromatic_centroid[n],
            "rays_passed_percent": 100.0 * passed[n],
        }
        for n, point in enumerate(_fields(where))
    ]
    off = (fine.polychromatic_rms - coarse.polychromatic_rms).abs().nan_to_num().amax()
    return plain(rows), 1e3 * float(off)


def show(prescription: Prescription, picture: bool, text: bool = False) -> Answer:
    """Tell first-order data, surfaces, Seidel sums and spots of a lens, and draw its section.

    Args:
        prescription: of the lens.
        picture: whether one is wanted.
        text: whether to give the prescription as YAML besides.
    """
    lens: Any = prepared_lens(lens_of(prescription))
    where = conditions(lens)
    found = lens.summary()
    fine, coarse = (spot_diagram(lens, where, n) for n in (_RAYS, _RAYS // 2))
    spots, off = _about(fine, coarse)
    answer = Answer(
        plain(
            {
                "name": lens.name,
                "efl_mm": found.efl,
                "f_number": found.f_number,
                "working_f_number": found.working_f_number,
                "back_focus_mm": lens.sensor_distance,
                "paraxial_back_focal_distance_mm": found.bfd,
                "total_track_mm": found.total_track,
                "entrance_pupil_diameter_mm": found.entrance_pupil_diameter,
                "entrance_pupil_z_mm": found.entrance_pupil_z,
                "exit_pupil_z_mm": found.exit_pupil_z,
                "defocus_mm": found.defocus,
                "magnification": found.magnification,
                "object_distance_mm": where.object_distance,
                "airy_radius_um": found.airy_radius_um,
                "wavelengths_nm": where.wavelengths,
                "reference_wavelength_nm": where.reference_wavelength,
                "stop_surface": lens.stop,
                "seidel_um": {k: 1e3 * v for k, v in found.seidel.items()},
                "spots": spots,
                "surfaces": {n: _row(row) for n, row in prescription["surfaces"].items()},
            }
        )
    )
    if text:
        words = yaml_of(prescription, "the prescription").decode()
        if len(words) > _LONGEST_TEXT:
            raise InputError(f"show: the text has {len(words)} letters; allowed: {_LONGEST_TEXT}")
        answer.values["prescription"] = words
    if found.stop_note:
        answer.notes.append(found.stop_note)
    answer.errs("first-order data", 0.0, "", "paraxial optics, exact but for rounding")
    answer.errs("spots", off, "µm", "2000 rays a spot against 1000, the most of all fields")
    answer.show(_section(lens, where) if picture else None, picture)
    return answer


def _row(row: Any) -> dict[str, Any]:
    """Return a surface's row with short lists alone: a freeform has hundreds of coefficients."""
    return {k: v for k, v in row.items() if not isinstance(v, list) or len(v) <= 20}


def _section(lens: Lens, where: Conditions) -> Figure:
    return lens_section_figure(lens, where, 7)


def trace(
    prescription: Prescription,
    field: Sequence[float],
    pupil: Sequence[Sequence[float]],
    wavelength: float | None,
    path: bool,
    picture: bool,
) -> Answer:
    """Trace rays of a field through given points of the stop.

    Args:
        prescription: of the lens.
        field: x and y, degrees, or mm on a near object.
        pupil: x and y on the stop of each ray, over its semi-diameter.
        wavelength: nm; None: the reference wavelength.
        path: whether to tell where the first ray meets every surface.
        picture: whether one is wanted.
    """
    lens: Any = prepared_lens(lens_of(prescription), [list(field)])
    where = conditions(lens)
    wave = lens.primary_wavelength if wavelength is None else wavelength
    with torch.no_grad():
        aimed = lens.aim(list(field), pupil, wave, where.object_distance)
        hit = lens.trace(aimed)
    rays = [
        {
            "pupil": list(point),
            "status": Status(int(status)).name,
            "sensor_mm": position[:2],
            "direction": direction,
            "path_length_mm": length,
            "aimed": aim,
        }
        for point, status, position, direction, length, aim in zip(
            pupil,
            hit.status.tolist(),
            hit.position.tolist(),
            hit.direction.tolist(),
            hit.path_length.tolist(),
            aimed.converged.tolist(),
            strict=True,
        )
    ]
    answer = Answer(plain({"wavelength_nm": wave, "rays": rays}))
    if path:
        with torch.no_grad():
            first = lens.explain(lens.aim(list(field), list(pupil[0]), wave, where.object_distance))
        answer.values["path_of_first"] = [plain(vars(each)) for each in first.crossings]
        answer.values["first_ends"] = first.ending
    failed = sum(row["status"] != "OK" for row in rays)
    answer.errs("rays", failed, "rays", "so many do not reach the sensor within the apertures")
    answer.errs("sensor_mm", 0.0, "mm", _ROUNDING)
    answer.show(_section(lens, where) if picture else None, picture)
    return answer


# ---------------------------------------------------------------- analyses


def _spots(lens: Lens, where: Conditions, _: Any) -> tuple[Answer, Figure]:
    fine, coarse = (spot_diagram(lens, where, n) for n in (_RAYS, _RAYS // 2))
    rows, off = _about(fine, coarse)
    mean = 1e3 * (fine.polychromatic_rms * where.field_weights).sum()
    answer = Answer(plain({"mean_rms_spot_um": mean, "fields": rows}))
    answer.values["airy_radius_um"] = plain(1e3 * fine.airy_radius)
    answer.errs("rms_um", off, "µm", "2000 rays a spot against 1000, the most of all fields")
    lost = (~fine.valid & (fine.weight > 0.0)).double().mean((1, 2))
    answer.errs("rays that fail or are clipped", 100.0 * lost, "%", "of each field")
    return answer, spots_figure(fine, True, title_of("Spot diagram", lens, where))


def _ray_fans(lens: Lens, where: Conditions, _: Any) -> tuple[Answer, Figure]:
    fans = ray_fans(lens, where)
    step = (len(fans.coordinate) - 1) // (_TOLD - 1)
    answer = Answer(
        plain(
            {
                "pupil_coordinate": fans.coordinate[::step],
                f"fields_{_unit(where)}": where.fields,
                "wavelengths_nm": where.wavelengths,
                "tangential_um": fans.tangential_um[..., ::step],
                "sagittal_um": fans.sagittal_um[..., ::step],
            }
        )
    )
    answer.errs("tangential_um, sagittal_um", 0.0, "µm", _ROUNDING)
    failed = (~fans.tangential_um.isfinite()).sum() + (~fans.sagittal_um.isfinite()).sum()
    answer.errs("rays that fail or are clipped", failed, "rays", "null in the lists")
    return answer, ray_fans_figure(fans, title_of("Ray fans", lens, where))


def _mtf(lens: Lens, where: Conditions, frequencies: Any) -> tuple[Answer, Figure]:
    given = frequencies is not None
    along = torch.tensor(frequencies).double() if given else frequency_range(lens, where, 33)
    found = diffraction_modulation(lens, where, along)
    told = slice(None) if given else slice(None, None, 4)
    answer = Answer(
        plain(
            {
                "frequencies_per_mm": found.frequencies[told],
                "fields": [
                    {
                        f"field_{_unit(where)}": point,
                        "tangential": found.tangential[n][told],
                        "sagittal": found.sagittal[n][told],
                        "diffraction": found.diffraction[n],
                    }
                    for n, point in enumerate(_fields(where))
                ],
            }
        )
    )
    answer.errs(
        "tangential, sagittal",
        found.sampling_error,
        "contrast",
        "of each field, against half of the pupil's samples; a scalar theory of diffraction",
    )
    return answer, modulation_comparison_figure(found, None, title_of("MTF", lens, where))


def _wavefront(lens: Lens, where: Conditions, _: Any) -> tuple[Answer, Figure]:
    fine, coarse = (wavefront_maps(lens, where, n) for n in (64, 32))
    terms = fine.zernike("fringe", 16).coefficients
    answer = Answer(
        plain(
            {
                "wavelengths_nm": where.wavelengths,
                "fields": [
                    {
                        f"field_{_unit(where)}": point,
                        "rms_waves": fine.rms[n],
                        "peak_to_valley_waves": fine.peak_to_valley[n],
                        "fringe_zernike_waves": terms[n],
                    }
                    for n, point in enumerate(_fields(where))
                ],
            }
        )
    )
    off = (fine.rms - coarse.rms).abs()
    answer.errs("rms_waves", off, "waves", "64 × 64 rays of each field against 32 × 32")
    return answer, wavefront_maps_figure(fine, title_of("Wavefront error", lens, where))


def _field_curves(lens: Lens, where: Conditions, _: Any) -> tuple[Answer, Figure]:
    curves = [
        field_curves(lens, scan, where.wavelengths)
        for scan in field_scans(lens, where.object_distance)
    ]
    scans = []
    for one in curves:
        step = (len(one.scan.coordinate) - 1) // (_TOLD - 1)
        scans.append(
            {
                "along": one.scan.axis,
                f"field_{_unit(where)}": one.scan.coordinate[::step],
                "distortion_percent": one.distortion[::step],
                "tangential_focus_mm": one.tangential[::step],
                "sagittal_focus_mm": one.sagittal[::step],
            }
        )
    largest = max(float(one.distortion.abs().nan_to_num().amax()) for one in curves)
    answer = Answer(plain({"largest_distortion_percent": largest, "scans": scans}))
    answer.errs("distortion_percent, foci", 0.0, "", f"parabasal and chief rays; {_ROUNDING}")
    return answer, field_curves_figure(curves, title_of("Field curves", lens, where))


def _lateral_colour(lens: Lens, where: Conditions, _: Any) -> tuple[Answer, Figure]:
    waves = where.wavelengths if len(where.wavelengths) > 1 else spectral_lines(lens)
    curves = [
        lateral_colour(lens, scan, waves) for scan in field_scans(lens, where.object_distance)
    ]
    step = (len(curves[0].scan.coordinate) - 1) // (_TOLD - 1)
    answer = Answer(
        plain(
            {
                "wavelengths_nm": curves[0].wavelengths,
                f"field_{_unit(where)}": curves[0].scan.coordinate[::step],
                "shift_um": [one.shift_um[::step] for one in curves],
                "airy_radius_um": curves[0].airy_radius_um,
            }
        )
    )
    answer.errs("shift_um", 0.0, "µm", f"chief rays; {_ROUNDING}")
    title = title_of("Lateral colour", lens, where)
    return answer, lateral_colour_figure(curves, None, title)


def _encircled_energy(lens: Lens, where: Conditions, _: Any) -> tuple[Answer, Figure]:
    waves = diffraction_encircled_energy(lens, where)
    rays, fewer = (encircled_energy(lens, where, waves.radii_um, n) for n in (4000, 2000))
    shares = (0.5, 0.8, 0.9)
    answer = Answer(
        plain(
            {
                f"fields_{_unit(where)}": where.fields,
                "radius_um": {f"{100 * s:g}_percent": waves.radius_um(s) for s in shares},
                "radius_of_rays_um": {f"{100 * s:g}_percent": rays.radius_um(s) for s in shares},
                "diffraction": list(waves.diffraction),
            }
        )
    )
    off = (rays.energy - fewer.energy).abs().nan_to_num().amax()
    answer.errs("energy of rays", off, "share", "4000 rays against 2000, at any radius")
    title = title_of("Encircled energy", lens, where)
    return answer, encircled_energy_figure(waves, rays, title)


def _illumination(lens: Lens, where: Conditions, _: Any) -> tuple[Answer, Figure]:
    curves = [
        relative_illumination(lens, scan, where.reference_wavelength)
        for scan in field_scans(lens, where.object_distance)
    ]
    step = (len(curves[0].scan.coordinate) - 1) // (_TOLD - 1)
    answer = Answer(
        plain(
            {
                f"field_{_unit(where)}": curves[0].scan.coordinate[::step],
                "relative": [one.relative[::step] for one in curves],
                "cosine_fourth": curves[0].cosine_fourth[::step],
            }
        )
    )
    answer.errs("relative", None, "", "the solid angle of the exit beam, by quadrature over rays")
    title = title_of("Relative illumination", lens, where)
    return answer, illumination_figure(curves, title)


ANALYSES: dict[str, Callable[[Lens, Conditions, Any], tuple[Answer, Figure]]] = {
    "spots": _spots,
    "ray_fans": _ray_fans,
    "mtf": _mtf,
    "wavefront": _wavefront,
    "field_curves": _field_curves,
    "lateral_colour": _lateral_colour,
    "encircled_energy": _encircled_energy,
    "relative_illumination": _illumination,
}


def analyse(
    prescription: Prescription,
    what: str,
    fields: Any,
    wavelengths: Sequence[float] | None,
    f_number: float | None,
    frequencies: Sequence[float] | None,
    picture: bool,
) -> Answer:
    """Analyse a lens.

    Args:
        prescription: of the lens.
        what: a name in `ANALYSES`.
        fields: numbers along y or points (x, y), degrees or mm; None: the lens's own.
        wavelengths: nm; None: the lens's own.
        f_number: EFL over the entrance pupil's diameter; None: the lens's own.
        frequencies: cycles/mm, of the MTF; None: up to where little contrast is left.
        picture: whether one is wanted.
    """
    lens = prepared_lens(lens_of(prescription), _points(fields), wavelengths, f_number)
    with torch.no_grad():
        answer, figure = ANALYSES[what](lens, conditions(lens), frequencies)
    answer.show(figure, picture)
    return answer


def _points(fields: Any) -> list[list[float]] | None:
    from dolens.analysis.fields_and_wavelengths import field_points

    return None if fields is None else field_points(fields).tolist()
