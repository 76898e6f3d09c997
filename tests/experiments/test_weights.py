"""Weights of wavelengths and fields: polychromatic values, merit functions and means use them."""

import copy

import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.encircled_energy import encircled_energy
from dolens.analysis.modulation_transfer import frequency_range, modulation
from dolens.analysis.rms_curves import rms_against_field
from dolens.analysis.spot_diagram import spot_diagram
from dolens.diffraction.huygens import huygens_point_spread, huygens_window
from dolens.diffraction.point_spread import diffraction_encircled_energy, point_spread
from dolens.diffraction.transfer import diffraction_modulation
from dolens.errors import InputError
from dolens.experiments.design.merit_rays import (
    merit_modulation,
    merit_rms_against_field,
    merit_spots,
)
from dolens.experiments.design.tables import spot_table
from dolens.experiments.settings import PupilRays, Spots
from dolens.experiments.tolerances.tolerances import MonteCarlo, TolerancesModule
from dolens.lens_page.offenders import offenders
from dolens.lens_page.overview import lens_overview
from dolens.lens_page.preparation import prepared_lens
from dolens.lens_page.sections import PageSections
from dolens.lens_search.sensitivity import lens_sensitivity
from dolens.optics.aperture_setting import with_aperture
from dolens.optics.fields import Fields
from dolens.optimize import DesignVariables, MeritSettings
from dolens.prescriptions import lens_from_prescription
from dolens.prescriptions.files import load_lens as from_file

WAVES = (656.2725, 587.5618, 486.1327)
MIDDLE = WAVES[1]
FIELDS = ((0.0, 0.0), (0.0, 14.0))
RADII = (2.0, 5.0, 10.0, 20.0)
FREQUENCIES = (10.0, 30.0, 60.0)


@pytest.fixture(scope="module")
def triplet(root):
    lens = with_aperture(load_lens(root / "conf/lens/cooke_triplet.yaml"), f_number=8.0)
    lens.fields = Fields("angles", FIELDS)
    return lens.requires_grad_(False)


def weighted(lens, wavelengths, weights=None):
    """The lens with other wavelengths and weights of its own; the middle line is the reference."""
    found = copy.deepcopy(lens)
    found.wavelengths, found.wavelength_weights = tuple(wavelengths), weights
    found.reference_wavelength = MIDDLE
    return found


def numbers(*values):
    return torch.cat([torch.as_tensor(value, dtype=torch.float64).flatten() for value in values])


def own(lens):
    return FIELDS, lens.wavelengths


def of_summary(lens):
    rows = lens.summary().fields
    return numbers([row.rms_spot_um for row in rows], [row.geo_spot_um for row in rows])


def of_page(lens):
    sections = PageSections(lens, lens_overview(lens))
    spread = sections._spread
    return numbers(sections.overview.spots.polychromatic_rms, spread.strehl_ratio)


def of_point_spread(lens):
    found = point_spread(lens, *own(lens), cells=32, half_width_um=30.0)
    return numbers(found.irradiance, found.strehl_ratio, found.centre, found.airy_radius_um)


def of_huygens(lens):
    found = huygens_point_spread(lens, FIELDS[:1], lens.wavelengths, cells=8, half_width_um=6.0)
    return numbers(found.irradiance, found.centre, found.airy_radius_um)


def of_transfer(lens):
    found = diffraction_modulation(lens, *own(lens), FREQUENCIES)
    return numbers(found.tangential, found.sagittal, found.tangential_limit)


def of_rays_transfer(lens):
    found = modulation(lens, *own(lens), FREQUENCIES, 2000)
    return numbers(found.tangential, found.sagittal, found.diffraction_limit)


def of_offenders(lens):
    found = offenders(lens, conditions(lens), "default")
    return numbers(found.contributions.nominal, found.contributions.share)


def of_sensitivity(lens):
    found = lens_sensitivity(lens)
    return numbers(found.nominal_um, found.expected_um)


def of_design_figures(lens):
    settings = MeritSettings()
    found, _ = merit_modulation(lens, settings, torch.tensor(FREQUENCIES).double())
    curves = merit_rms_against_field(lens, settings, FIELDS[1])
    spots = merit_spots(lens, settings)
    return numbers(
        *(found.tangential, found.diffraction_limit, curves.polychromatic),
        *(spots.polychromatic_rms, spot_table(lens, settings).mean),
    )


def of_grid(lens):
    settings = MeritSettings(sampling="square_grid", sampling_options={"half_width": 2.0})
    found, _ = merit_modulation(lens, settings, torch.tensor(FREQUENCIES).double())
    return numbers(
        merit_spots(lens, settings).polychromatic_rms, found.sagittal, found.diffraction_limit
    )


def of_tolerances(lens):
    # Every field and wavelength that the analysis names is the lens's own.
    spots = Spots(FIELDS, lens.wavelengths, PupilRays(2, 6))
    module = TolerancesModule(
        *(lens, "", "", spots, None, {"surfaces.*.curvature": {"half_range": 1e-4}}, 1.0),
        *(MonteCarlo(4, None, 0), ()),
    )
    # Drawn lenses vary with the seed alone.
    found = module.analyse()
    return numbers(
        [found[f"tolerance/{what}/nominal"] for what in ("rms_um", "worst_rms_um")],
        [found["tolerance/linear/expected_rms_um"]],
    )


def merit_of(**settings):
    def found(lens):
        merit = MeritSettings(**settings)
        quality = merit.image_quality(lens)
        return numbers(quality.values(lens).merit, quality.loss(lens, {}))

    return found


def focus_of(lens):
    quality = MeritSettings(reference_spectrum="polychromatic").image_quality(lens)
    values = quality.values(lens)
    return numbers(quality.best_focus(values, quality.slopes(values)))


POLYCHROMATIC = {
    "summary": of_summary,
    "page": of_page,
    "spots": lambda lens: numbers(
        *(lambda s: (s.polychromatic_centroid, s.polychromatic_rms))(spot_diagram(lens, *own(lens)))
    ),
    "rms curve": lambda lens: rms_against_field(lens, lens.wavelengths, count=3).polychromatic,
    "encircled energy of rays": lambda lens: encircled_energy(lens, *own(lens), RADII).energy,
    "encircled energy": lambda lens: diffraction_encircled_energy(lens, *own(lens), RADII).energy,
    "point spread": of_point_spread,
    "Huygens": of_huygens,
    "window of Huygens": lambda lens: numbers(
        huygens_window(lens, torch.tensor(FIELDS[1]).double(), lens.wavelengths)
    ),
    "MTF": of_transfer,
    "MTF of rays": of_rays_transfer,
    "frequencies": lambda lens: frequency_range(lens, *own(lens)),
    "worst offenders": of_offenders,
    "sensitivity": of_sensitivity,
    "design": of_design_figures,
    "design on a grid": of_grid,
    "tolerances": of_tolerances,
    "best focus": focus_of,
    "merit: spots": merit_of(),
    "merit: polychromatic": merit_of(reference_spectrum="polychromatic"),
    "merit: chief": merit_of(reference="chief", reference_spectrum="polychromatic"),
    "merit: wavefront": merit_of(quality="wavefront", reference_spectrum="polychromatic"),
    "merit: modulation": merit_of(quality="modulation", reference_spectrum="polychromatic"),
    "merit: energy": merit_of(quality="encircled_energy", quality_options={"radius_um": 8.0}),
}


@pytest.mark.parametrize("name", POLYCHROMATIC)
def test_weights_are_shares_of_the_light(triplet, name):
    found = POLYCHROMATIC[name]
    alone = found(weighted(triplet, [MIDDLE]))
    twice = found(weighted(triplet, (WAVES[0], MIDDLE, MIDDLE, WAVES[2])))
    # A wavelength of weight zero does not count at all.
    torch.testing.assert_close(
        found(weighted(triplet, WAVES, (0, 1, 0))), alone, rtol=1e-9, atol=1e-12
    )
    torch.testing.assert_close(
        found(weighted(triplet, WAVES, (1, 2, 1))), twice, rtol=1e-9, atol=1e-12
    )
