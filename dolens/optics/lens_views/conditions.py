"""The conditions at which a lens shows itself, and the title and the place of its figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.conditions import Conditions, FieldPoints
    from dolens.optics.lens import Lens

Wavelengths = float | Sequence[float] | Tensor | None


def as_lens(views: Any) -> Lens:
    """Return the lens whose methods these views are."""
    return views


def looked_at(
    lens: Any,
    fields: FieldPoints | None,
    wavelengths: Wavelengths,
    object_distance: float | None,
    aperture: dict[str, float],
) -> tuple[Lens, Conditions]:
    """Return the lens at an aperture, and the conditions that it is looked at."""
    from dolens.analysis.conditions import conditions
    from dolens.errors import check_keys
    from dolens.optics.aperture_setting import with_aperture

    check_keys(aperture, ("f_number", "entrance_pupil_diameter"), "aperture")
    lens = with_aperture(lens, **aperture)
    return lens, conditions(lens, fields, wavelengths, object_distance)


def title_of(what: str, lens: Lens, given: Conditions) -> str:
    """Return the title of a figure: what it shows, of which lens, and at which conditions."""
    from dolens.plotting.captions import caption

    return caption(what, lens, given.wavelengths, given.object_distance)


def shown(figure: Figure) -> Figure:
    """Return a figure that a notebook shows, once, whether pyplot was imported or not."""
    from dolens.plotting.notebook import showing

    return showing(figure)
