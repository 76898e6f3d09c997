"""A lens shows its numbers, its section and its footprints, at conditions that all views share."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from inspect import signature
from typing import TYPE_CHECKING, Any

from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.conditions import Conditions
    from dolens.analysis.fields_and_wavelengths import FieldPoints
    from dolens.analysis.ray_path import RayPath
    from dolens.analysis.summary import LensSummary
    from dolens.optics.lens import Lens
    from dolens.optics.rays import Rays


class OverviewViews:
    """Methods of `Lens` that show it as a whole; see `LensViews` for their arguments."""

    def summary(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        **aperture: float,
    ) -> LensSummary:
        """Return first-order data, Seidel sums and spot radii; it shows itself as text or HTML."""
        from dolens.analysis.summary import lens_summary

        lens, given = looked_at(self.summary, fields, wavelengths, object_distance, aperture)
        return lens_summary(lens, given)

    def explain(self, rays: Rays) -> RayPath:
        """Follow one ray surface by surface, and say why it ends where it does.

        See `analysis.ray_path.ray_path`; `lens.chief_ray(field)` is such a ray.
        """
        from dolens.analysis.ray_path import ray_path

        return ray_path(as_lens(self), rays)

    def draw(
        self,
        fields: FieldPoints | None = None,
        wavelengths: Wavelengths = None,
        object_distance: float | None = None,
        rays: int = 7,
        **aperture: float,
    ) -> Figure:
        """Draw the section in the y-z plane with the rays of the fields in that plane.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelengths: rays of the reference or nearest one are drawn.
            object_distance: see the class.
            rays: of each field.
            aperture: see the class.
        """
        from dolens.plotting.lens_section import lens_section_figure

        lens, given = looked_at(self.draw, fields, wavelengths, object_distance, aperture)
        return shown(lens_section_figure(lens, given, rays))

    def footprint(
        self,
        fields: FieldPoints | None = None,
        wavelength: float | None = None,
        object_distance: float | None = None,
        rays: int = 1000,
        **aperture: float,
    ) -> Figure:
        """Draw where the rays of the fields meet every surface; see `analysis.footprint.footprint`.

        Args:
            fields: see the class, as the other arguments that are not named here.
            wavelength: nm; None for the reference wavelength.
            object_distance: see the class.
            rays: of each field, a multiple of four.
            aperture: see the class.
        """
        from dolens.analysis.footprint import footprint
        from dolens.plotting.footprint import footprint_figure

        wavelength = wavelength or as_lens(self).primary_wavelength
        lens, given = looked_at(self.footprint, fields, wavelength, object_distance, aperture)
        found = footprint(lens, given, wavelength, rays)
        return shown(footprint_figure(found, title_of("Footprints", lens, given)))


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
    from dolens.optics.field_and_aperture import with_aperture

    settings = ("f_number", "entrance_pupil_diameter")
    named = [name for name in signature(view).parameters if name != "aperture"]
    check_keys(aperture, (*named, *settings), f"{view.__name__}()")
    lens = with_aperture(view.__self__, **aperture)
    return lens, conditions(lens, fields, wavelengths, object_distance)


def title_of(what: str, lens: Lens, given: Conditions, draft: bool = False) -> str:
    """Return the title of a figure: what it shows, of which lens, at which conditions, and whether
    it is a draft.
    """
    from dolens.plotting.style import caption

    return caption(f"{what} (draft)" if draft else what, lens, given)


# Fields times wavelengths times surfaces up to which a draft is traced without kernels.
_SMALL = 80


def traced_at_once(lens: Lens, given: Conditions) -> Lens:
    """Return a lens for drafts: a small one without kernels, which must be loaded or compiled.

    PyTorch traces it as fast as kernels do once they are there.  Which of them does depends on
    nothing else, so that the last digits do not.
    """
    spots = len(given.fields) * len(given.wavelengths)
    if lens.backend != "auto" or spots * len(lens.surfaces) > _SMALL:
        return lens
    found = copy.copy(lens)
    found.backend = "reference"
    return found


def shown(figure: Figure, draft: bool = False) -> Figure:
    """Return a figure that a notebook shows, once, whether pyplot was imported or not.

    Args:
        figure: of any kind.
        draft: whether it is one; its attribute `draft` says so.
    """
    from dolens.plotting.export import showing

    figure.draft = draft  # type: ignore[attr-defined]
    return showing(figure)
