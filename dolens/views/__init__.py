"""What a lens shows of itself, in a notebook above all.

The methods call analysis, diffraction and plotting.  `Lens` finds them by `LENS_METHODS` of
`dolens.optics` when one is called, so that a lens is traced and trained without them.  Every method
takes the lens's own fields, wavelengths and object distance unless others are given (see
`dolens.analysis.conditions` for the defaults of a lens that names none), and returns a figure that
belongs to nobody else: pyplot does not know it.

The numbers behind each figure come from the functions that the methods call.
"""

from dolens.views.design import DesignViews
from dolens.views.ghosts import GhostViews
from dolens.views.image_quality import ImageQualityViews
from dolens.views.light import LightViews
from dolens.views.overview import OverviewViews
from dolens.views.photographs import PhotographViews


class LensViews(
    OverviewViews, ImageQualityViews, LightViews, GhostViews, DesignViews, PhotographViews
):
    """Methods of `Lens` that show it.

    Arguments that all of them share:

        fields: numbers along y or points (x, y): degrees for an object at infinity, mm on the
            object for a near one.
        wavelengths: nm.
        object_distance: mm in front of the first vertex, `inf` for infinity.
        f_number: EFL over the diameter of the entrance pupil, of a copy of the lens whose stop is
            set to it; or
        entrance_pupil_diameter: mm.

    They raise `InputError` where a value cannot be used; a field that no light reaches is shown as
    such.
    """
