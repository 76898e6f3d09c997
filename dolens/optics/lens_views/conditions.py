"""The conditions at which a lens shows itself, and the title and the place of its figures."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
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
    view: Any,
    fields: FieldPoints | None,
    wavelengths: Wavelengths,
    object_distance: float | None,
    aperture: dict[str, float],
) -> tuple[Lens, Conditions]:
    """Return the lens of a view at an aperture, and the conditions that it is looked at.

    Args:
        view: the method of the lens that was called.
        fields: see `LensViews`, as the next two.
        wavelengths: nm.
        object_distance: mm.
        aperture: the other keyword arguments of the call.

    Raises:
        InputError: the method has no such argument.
    """
    from dolens.analysis.conditions import conditions
    from dolens.errors import check_keys
    from dolens.optics.aperture_setting import with_aperture

    settings = ("f_number", "entrance_pupil_diameter")
    named = [name for name in signature(view).parameters if name != "aperture"]
    check_keys(aperture, (*named, *settings), f"{view.__name__}()")
    lens = with_aperture(view.__self__, **aperture)
    return lens, conditions(lens, fields, wavelengths, object_distance)


def title_of(what: str, lens: Lens, given: Conditions) -> str:
    """Return the title of a figure: what it shows, of which lens, and at which conditions."""
    from dolens.plotting.captions import caption

    return caption(what, lens, given.wavelengths, given.object_distance)


def shown(figure: Figure) -> Figure:
    """Return a figure that a notebook shows, once, whether pyplot was imported or not."""
    from dolens.plotting.export import showing

    return showing(figure)
