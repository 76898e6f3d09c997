"""Pupils of the packaged lenses at random fields, as designed or within tolerances."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.pupil_fit import PupilFit, fit_pupil, regular_pupil
from dolens.diffraction.reference_sphere import chief_ray_intercepts
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.errors import InputError
from dolens.experiments.pretraining.random_pupils import COARSE, GREEN, Draw
from dolens.files import packaged_configuration
from dolens.optics.lens import Lens
from dolens.prescriptions.files import load_lens
from dolens.tolerancing.tolerances import tolerances_from, usual_tolerances, with_glass_elements

# The restorer is judged by these lenses, so that none of its training functions come from them.
HELD_OUT = (
    # A triplet, and three more of nearly its curvatures.
    "cooke_triplet",
    "published/cooke_triplet_oslo",
    "published/cooke_triplet_sasian",
    "published/uv_triplet_jps42_9417",
    "double_gauss",
    "large_fov_doublet",
    "large_fov_doublet_designed",
    # Singlets.
    "la1131",
    "la1509",
    "lb1757",
    # Lenses of telephones.
    "phone",
    "phone_insensitive",
    "published/mobile_us7535658_odd",
    # Telephoto lenses.
    "published/doe_telephoto_jp2015102852_ex1",
    "published/doe_telephoto_jp2020173349_ex1",
    "published/internal_focus_jp2008145584_ex1",
    "published/internal_focus_jph04294310_ex1",
    "published/mangin_reflex_us3507556_e1",
    "published/mangin_reflex_us4666259_ex1",
    "published/mangin_reflex_us4951078_t1",
    "published/telephoto_laikin_p91",
    "published/telephoto_smith_p175_sigler",
    "published/telephoto_us3942876_ex4",
    "published/telephoto_us4154508_ex2",
    # A Tessar, to be read as another program's file.
    "published/tessar_us2573511_ex1",
    # The default experiment's own plate.
    "wavefront_coding",
)
# These make no image of a point in all colours.
_NO_CAMERAS = (
    "published/axicon_ring_focus",
    "published/cylinder_thorlabs_lj1567",
    "published/spectrometer_czerny_turner",
    "published/spectrometer_dyson_montero_orille",
    "published/spectrometer_prism",
    "published/spectrometer_toroidal_grating",
)
# The share of a lens's flux that its fit may miss.
_FLUX = 0.03
# mm, stands for the focal length of a lens without power.
_NO_LENGTH = 100.0


class TracedField(NamedTuple):
    """Pupils of a lens's field.

    Attributes:
        fit: of two wavelengths for each of red, green and blue.
        focal_length: mm.
        name: of the lens.
    """

    fit: PupilFit
    focal_length: float
    name: str


class Prescriptions:
    """The packaged prescriptions, less those that are held out; each is read when it is drawn."""

    def __init__(self) -> None:
        folder = packaged_configuration() / "lens"
        files = sorted([*folder.glob("*.yaml"), *folder.glob("published/*.yaml")])
        named = {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}
        self.files: dict[str, Path] = {
            name: file for name, file in named.items() if name not in HELD_OUT + _NO_CAMERAS
        }
        self.kept: dict[str, Lens] = {}
        self.again: TracedField | None = None

    @torch.no_grad()
    def traced(self, draw: Draw) -> TracedField | None:
        """Draw a field; None where the lens drawn has no light or no smooth wavefront there.

        Tracing takes the most time, and so a field is drawn twice on average.
        """
        found, self.again = self.again or self._trace(draw), None
        if found is not None and draw.chance(0.5):
            self.again = found
        return found

    def _trace(self, draw: Draw) -> TracedField | None:
        name = draw.one_of(list(self.files))
        if name not in self.kept:
            self.kept[name] = load_lens(self.files[name], dtype=torch.float64)
        lens, what = self.kept[name], f"lens {name}"
        field = random_field(lens, draw)
        if draw.chance(0.5):
            what += ", within tolerances"
            lens = within_tolerances(lens, draw, draw.log_uniform(0.5, 4.0))
        lateral_colour, waves = draw.chance(0.3), draw.bands()
        try:
            fit = fitted_pupils(lens, field, waves, lateral_colour)
            length = abs(float(lens.first_order(GREEN).efl))
        except InputError:
            return None
        if fit is None:
            return None
        return TracedField(fit, length if 0.0 < length < math.inf else _NO_LENGTH, what)


def random_field(lens: Lens, draw: Draw) -> tuple[float, float]:
    """Return a field (degrees or mm) within a lens's, evenly drawn from the field's area."""
    points = lens.fields.points if lens.fields else ((0.0, 0.0),)
    farthest = max(math.hypot(*point) for point in points)
    if lens.system().rotationally_symmetric:
        radius, angle = farthest * math.sqrt(draw.uniform()), draw.uniform(0.0, 2.0 * math.pi)
        return radius * math.cos(angle), radius * math.sin(angle)
    shares = [-math.log(max(draw.uniform(), 1e-12)) for _ in points]
    x, y = (sum(s * p[axis] for s, p in zip(shares, points, strict=True)) for axis in (0, 1))
    return x / sum(shares), y / sum(shares)


def within_tolerances(lens: Lens, draw: Draw, factor: float) -> Lens:
    """Return a copy of a lens with random errors within so many times the usual tolerances."""
    made = with_glass_elements(lens)
    settings = usual_tolerances(made)
    if not settings:
        return lens
    tolerances = tolerances_from(made, settings, factor)
    errors = tolerances.draw(1, draw.generator)[0]
    parameters = dict(made.named_parameters())
    for name, error in zip(tolerances.names, errors, strict=True):
        parameters[name].data.add_(error)
    return made


def fitted_pupils(
    lens: Lens, field: tuple[float, float], waves: Sequence[float], lateral_colour: bool
) -> PupilFit | None:
    """Return pupils about each colour's chief ray, or about green's; None without a fit."""
    system, distance = lens.system(), lens.object_distance
    if distance is None or distance == math.inf:
        points = ObjectPoints.at_infinity([field] * len(waves))
    else:
        points = ObjectPoints.at([(*field, -distance)] * len(waves))
    wavelengths = torch.tensor(waves, dtype=torch.float64)
    middles = wavelengths.unflatten(0, (3, -1)).mean(1)
    if lateral_colour:
        middles = middles[1].expand(3)
    centres = chief_ray_intercepts(system.double(), points, middles.repeat_interleave(2))
    front = pupil_wavefront(system, points, wavelengths, centres, 28)
    # Where rays that miss a surface make the edge, no aperture describes it.
    if bool(front.ended.any()) or not bool((front.flux > 1e-4).all()):
        return None
    fit = fit_pupil(front, 12)
    error = regular_pupil(fit, 2 * COARSE).flux / front.flux - 1.0
    return fit if bool((error.abs() <= _FLUX).all()) else None
