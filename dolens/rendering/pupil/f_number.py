"""The F-number of the axial beam."""

import torch

from dolens.optics.lens import Lens
from dolens.rendering.pupil.exit_pupil import axial_exit_pupil, working_f_number


@torch.no_grad()
def axial_f_number(lens: Lens) -> float:
    """The F-number that the axial beam works with: N = 1/(2·sin u'), u' the angle of its edge.

    A white Lambertian plane of radiance L gives the axial pixel the irradiance π·L·sin²u', which
    is π·L/(4N²), whatever the plane's distance.  The edge is that of the largest disc in the exit
    pupil which real rays fill, so the surface that limits the beam counts, be it the stop or not.

    Args:
        lens: as its parameters are stored, at its primary wavelength.

    Raises:
        InputError: no ray reaches the sensor's centre.
    """
    system = lens.system()
    pupil = axial_exit_pupil(system, (lens.primary_wavelength,))
    return working_f_number(pupil, float(system.vertices[-1]))
