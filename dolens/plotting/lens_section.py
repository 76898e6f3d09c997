"""The section of a lens at its own fields, for any object distance."""

import math
from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.optics.paraxial import entrance_pupil
from dolens.plotting.captions import caption
from dolens.plotting.layout import layout_figure


@torch.no_grad()
def lens_section_figure(
    lens: Lens,
    fields: Tensor,
    wavelengths: Sequence[float] | Tensor,
    field_unit: str = "°",
    object_distance: float | None = None,
    rays: int = 7,
    title: str | None = None,
) -> Figure:
    """Draw the section of a lens in the y-z plane with the rays of its fields in that plane.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm; those beside the y-z plane are left out.
        wavelengths: nm; rays of the reference or nearest one are drawn.
        field_unit: of the fields.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        rays: of each field.
        title: None for the lens, its aperture and the wavelength.

    Raises:
        InputError: see `layout_figure`.
    """
    waves = torch.as_tensor(wavelengths, dtype=torch.float64)
    wave = float(waves[int((waves - lens.primary_wavelength).abs().argmin())])
    heights = list(dict.fromkeys(y for x, y in fields.tolist() if x == 0.0)) or [0.0]
    angles = section_angles(lens, heights, wave, object_distance)
    if title is None:
        title = caption("Section", lens, [wave], object_distance)
    figure = layout_figure(lens, wave, angles, rays, object_distance, title)
    legend = figure.axes[0].get_legend()
    if legend is not None:
        for text, height in zip(legend.get_texts(), heights, strict=True):
            dark = " (no ray passes)" if "no ray" in text.get_text() else ""
            text.set_text(field_label((0.0, height), field_unit) + dark)
    return figure


def section_angles(
    lens: Lens, heights: Sequence[float], wavelength: float, object_distance: float | None
) -> list[float]:
    """Return the angles (degrees) of the chief rays of fields along y, as `layout_figure` takes
    them.

    Args:
        lens: the lens.
        heights: degrees, or mm on a near object.
        wavelength: nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """
    if object_distance is None:
        return list(heights)
    away = object_distance + float(entrance_pupil(lens.system().double(), wavelength).z)
    # Chief rays of a near object come down from a point above the axis.
    return [-math.degrees(math.atan(height / away)) + 0.0 for height in heights]
