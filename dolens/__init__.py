"""dolens: end-to-end co-design of optics and reconstruction."""

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays, Status
from dolens.optics.surfaces import register_surface
from dolens.prescriptions import load_lens, save_lens

__version__ = "0.1.0"

__all__ = ["InputError", "Lens", "Rays", "Status", "load_lens", "register_surface", "save_lens"]
