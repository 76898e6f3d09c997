"""A surface shape has a file here, and registers itself under the `type` of a prescription."""

from dolens.kernels.shapes import Shape
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.kernels.table import GRAZING
from dolens.optics.surfaces.b_spline import BSpline
from dolens.optics.surfaces.base import PackedShape, Surface
from dolens.optics.surfaces.biconic import Biconic
from dolens.optics.surfaces.conic import Conic, Sphere
from dolens.optics.surfaces.coordinate_break import BREAKS, CoordinateBreak, TiltFirstBreak
from dolens.optics.surfaces.even_asphere import EvenAsphere
from dolens.optics.surfaces.forbes import QBfs, QCon
from dolens.optics.surfaces.grid_sag import GridSag
from dolens.optics.surfaces.ideal_lens import ParaxialLens
from dolens.optics.surfaces.odd_asphere import OddAsphere
from dolens.optics.surfaces.phase import PHASES, Grating, Phase, RadialPhase, XYPhase
from dolens.optics.surfaces.plane import Aperture, Plane
from dolens.optics.surfaces.registry import SURFACES, register_surface, unregister_surface
from dolens.optics.surfaces.state import LawState, SurfaceState
from dolens.optics.surfaces.toroid import Toroid
from dolens.optics.surfaces.xy_polynomial import XYPolynomial
from dolens.optics.surfaces.zernike import ZernikeFringe, ZernikeStandard
from dolens.optics.surfaces.zernike_phase import ZernikeFringePhase, ZernikeStandardPhase

__all__ = [
    "BREAKS",
    "GRAZING",
    "PHASES",
    "SURFACES",
    "Aperture",
    "BSpline",
    "Biconic",
    "Conic",
    "CoordinateBreak",
    "EvenAsphere",
    "Grating",
    "GridSag",
    "LawState",
    "OddAsphere",
    "PackedShape",
    "ParaxialLens",
    "Phase",
    "Plane",
    "QBfs",
    "QCon",
    "RadialPhase",
    "Shape",
    "Sphere",
    "Surface",
    "SurfaceKernel",
    "SurfaceState",
    "TiltFirstBreak",
    "Toroid",
    "XYPhase",
    "XYPolynomial",
    "ZernikeFringe",
    "ZernikeFringePhase",
    "ZernikeStandard",
    "ZernikeStandardPhase",
    "register_surface",
    "unregister_surface",
]
