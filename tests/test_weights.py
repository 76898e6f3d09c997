"""Weights of wavelengths and fields: polychromatic values, merit functions and means use them."""

import copy
import textwrap

import pytest
import torch

from dolens import load_lens, save_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.encircled_energy import encircled_energy
from dolens.analysis.modulation_transfer import frequency_range, modulation
from dolens.analysis.spot_diagram import rms_against_field, spot_diagram
from dolens.diffraction.huygens import huygens_point_spread, huygens_window
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.point_spread import diffraction_encircled_energy, point_spread
from dolens.errors import InputError
from dolens.experiments.design.merit_rays import (
    merit_modulation,
    merit_rms_against_field,
    merit_spots,
)
from dolens.experiments.design.states import spot_table
from dolens.experiments.settings import PupilRays, Spots
from dolens.experiments.tolerances.tolerances import MonteCarlo, TolerancesModule
from dolens.lens_page.offenders import offenders
from dolens.lens_page.overview import lens_overview, prepared_lens
from dolens.lens_page.sections import PageSections
from dolens.lens_search.form_report import lens_sensitivity
from dolens.optics.field_and_aperture import with_aperture
from dolens.optics.fields import Fields
from dolens.optimize import DesignVariables, MeritSettings

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
    found = point_spread(lens, conditions(lens, *own(lens)), cells=32, half_width_um=30.0)
    return numbers(found.irradiance, found.strehl_ratio, found.centre, found.airy_radius_um)


def of_huygens(lens):
    # Slow beams need few wavelets.
    slow = with_aperture(lens, f_number=25.0)
    found = huygens_point_spread(
        slow, conditions(slow, FIELDS[:1], lens.wavelengths), cells=4, half_width_um=6.0
    )
    return numbers(found.irradiance, found.centre, found.airy_radius_um)


def of_transfer(lens):
    found = diffraction_modulation(lens, conditions(lens, *own(lens)), FREQUENCIES)
    return numbers(found.tangential, found.sagittal, found.tangential_limit)


def of_rays_transfer(lens):
    found = modulation(lens, conditions(lens, *own(lens)), FREQUENCIES, 2000)
    return numbers(found.tangential, found.sagittal, found.diffraction_limit)


def of_offenders(lens):
    found = offenders(lens, conditions(lens), "default")
    return numbers(found.contributions.nominal, found.contributions.share)


def of_sensitivity(lens):
    found = lens_sensitivity(lens)
    return numbers(found.nominal_um, found.expected_um)


def of_design_figures(lens):
    settings = MeritSettings(sampling_options={"rings": 3, "arms": 6})
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
        *(lens, spots, None, {"surfaces.*.curvature": {"half_range": 1e-4}}, 1.0),
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
        *(lambda s: (s.polychromatic_centroid, s.polychromatic_rms))(
            spot_diagram(lens, conditions(lens, *own(lens)))
        )
    ),
    "rms curve": lambda lens: rms_against_field(lens, conditions(lens), count=3).polychromatic,
    "encircled energy of rays": lambda lens: (
        encircled_energy(lens, conditions(lens, *own(lens)), RADII).energy
    ),
    "encircled energy": lambda lens: (
        diffraction_encircled_energy(lens, conditions(lens, *own(lens)), RADII).energy
    ),
    "point spread": of_point_spread,
    "Huygens": of_huygens,
    "window of Huygens": lambda lens: numbers(huygens_window(lens, conditions(lens, FIELDS[1:2]))),
    "MTF": of_transfer,
    "MTF of rays": of_rays_transfer,
    "frequencies": lambda lens: frequency_range(lens, conditions(lens, *own(lens))),
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
    # Sums of wavelets are in single precision.
    close = {"rtol": 1e-6, "atol": 1e-10}
    # A wavelength of weight zero does not count at all.
    torch.testing.assert_close(found(weighted(triplet, WAVES, (0, 1, 0))), alone, **close)
    torch.testing.assert_close(found(weighted(triplet, WAVES, (1, 2, 1))), twice, **close)


def test_a_polychromatic_radius_is_a_weighted_mean_of_squares(triplet):
    spots = spot_diagram(triplet, conditions(triplet, FIELDS, WAVES, wavelength_weights=(1, 2, 5)))
    w = torch.tensor([1.0, 2.0, 5.0]).double()[:, None] / 8.0
    mean = (w * spots.centroid).sum(1)
    away = (spots.centroid - mean[:, None]).square().sum(-1)
    square = (w[:, 0] * (spots.rms.square() + away)).sum(1)
    torch.testing.assert_close(spots.polychromatic_rms, square.sqrt())


def test_other_wavelengths_than_the_lens_s_count_alike(triplet):
    lens = weighted(triplet, WAVES, (0, 1, 0))
    plain = weighted(triplet, WAVES)
    for waves in ((WAVES[0], 550.0, WAVES[2]), WAVES[:2]):
        found, wanted = (
            spot_diagram(of, conditions(of, FIELDS, waves)).polychromatic_rms
            for of in (lens, plain)
        )
        assert torch.equal(found, wanted)
    # Its own keep their weights in any order, on the command line too.
    turned = prepared_lens(weighted(triplet, WAVES, (1, 2, 4)), wavelengths=WAVES[::-1])
    assert conditions(turned).weights.tolist() == pytest.approx([4 / 7, 2 / 7, 1 / 7])
    assert conditions(prepared_lens(lens, wavelengths=WAVES[:2])).weights.tolist() == [0.5, 0.5]


# A biconvex lens in three formats; {} are the weights of F, d and C.
FILES = {
    "lens.yaml": """
        stop: 1
        wavelengths: [486.1, 587.6, 656.3]
        wavelength_weights: [{}, {}, {}]
        reference_wavelength: 587.6
        fields: {{angles: [[0, 0]]}}
        surfaces:
          '1': {{type: sphere, radius: 50, semi_diameter: 5, thickness: 5, material: N-BK7}}
          '2': {{type: sphere, radius: -50, semi_diameter: auto, material: air}}
        sensor: {{distance: 47.4}}
        """,
    "lens.zmx": """
        MODE SEQ
        UNIT MM
        ENPD 10
        GCAT SCHOTT
        FTYP 0 0 1 3 0 0 0
        XFLN 0
        YFLN 0
        WAVM 1 0.4861 {}
        WAVM 2 0.5876 {}
        WAVM 3 0.6563 {}
        PWAV 2
        SURF 0
          DISZ INFINITY
        SURF 1
          STOP
          CURV 0.02
          DISZ 5
          GLAS N-BK7 0 0 1.5 40 0 0
        SURF 2
          CURV -0.02
          DISZ 47.4
        SURF 3
          DISZ 0
        """,
    "lens.seq": """
        RDM;LEN
        EPD 10
        DIM M
        WL 486.1 587.6 656.3
        REF 2
        WTW {} {} {}
        YAN 0.0
        SO 0.0 0.1e14
        S 50.0 5.0 NBK7_SCHOTT
         STO
        S -50.0 47.4
        SI 0.0 0.0
        GO
        """,
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_s_weights_count(tmp_path, name):
    path = tmp_path / name

    def radius(*weights):
        path.write_text(textwrap.dedent(FILES[name]).strip().format(*weights) + "\n")
        return load_lens(path).summary().fields[0].rms_spot_um

    middle = radius(0, 1, 0)
    assert middle == pytest.approx(31.48, abs=0.02)
    # All about the axis: the mean of the squares of 67.8, 31.5 twice and 17.8 µm.
    assert radius(1, 2, 1) == pytest.approx(41.5, abs=0.1)
    with pytest.raises(InputError) as refused:
        radius(0, 0, 0)
    message = str(refused.value)
    assert name in message and "not all zero" in message and "\n" not in message


def test_field_weights_are_shares_in_means_over_fields(triplet):
    lens = copy.deepcopy(triplet)
    lens.fields = Fields("angles", FIELDS, weights=(1.0, 3.0))
    radii = torch.tensor(list(spot_table(triplet, MeritSettings()).radii.values())).double()
    axis, edge = radii.reshape(2, 3).mean(1).tolist()
    assert spot_table(lens, MeritSettings()).mean == pytest.approx(0.25 * axis + 0.75 * edge)
    given = MeritSettings(field_weights=[1, 1])
    assert spot_table(lens, given).mean == pytest.approx(0.5 * (axis + edge))
    # A field of weight zero has no rays in a merit, and no say in tolerances.
    lens.fields = Fields("angles", (*FIELDS, (0.0, 60.0)), weights=(1.0, 1.0, 0.0))
    assert spot_table(lens, MeritSettings()).radii == spot_table(triplet, MeritSettings()).radii
    torch.testing.assert_close(of_offenders(lens), of_offenders(triplet))
    torch.testing.assert_close(of_sensitivity(lens), of_sensitivity(triplet))


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kind", ["yaml", "zmx", "seq"])
def test_weights_go_with_a_lens_to_other_formats(tmp_path, name, kind):
    (tmp_path / name).write_text(textwrap.dedent(FILES[name]).strip().format(0, 2, 1) + "\n")
    lens = load_lens(tmp_path / name)
    save_lens(lens, tmp_path / f"other.{kind}")
    other = load_lens(tmp_path / f"other.{kind}")
    assert other.wavelength_weights == (0.0, 2.0, 1.0)
    found, wanted = (one.summary().fields[0].rms_spot_um for one in (other, lens))
    assert found == pytest.approx(wanted, rel=1e-9)


def test_weights_of_a_state_are_its_own(tmp_path):
    """Of the biconvex lens again, 0, 1, 0 is the middle line alone, in that state."""
    settings = {"WLWT 1": (1, 0), "WLWT 2": (2, 1), "WLWT 3": (1, 0), "FLWT 1": (1, 0)}
    fields = ("FTYP 0 0 2 3 0 0 0", "XFLN 0 0", "YFLN 0 5", "FWGN 1 3")
    text = textwrap.dedent(FILES["lens.zmx"]).strip().format(1, 2, 1)
    for old, new in zip(("FTYP 0 0 1 3 0 0 0", "XFLN 0\n", "YFLN 0\n"), fields, strict=False):
        text = text.replace(old, new + "\n" * old.endswith("\n"))
    rows = [f"{name} {n} {w}" for name, both in settings.items() for n, w in enumerate(both, 1)]
    path = tmp_path / "two.zmx"
    path.write_text("\n".join((fields[3], text, "MNUM 2 1", *rows, "")))
    lens = load_lens(path)
    assert lens.state_names == ("c1", "c2")
    of_states = {name: lens.in_state(name) for name in lens.state_names}
    radii = {n: [f.rms_spot_um for f in one.summary().fields] for n, one in of_states.items()}
    assert radii["c1"] == [f.rms_spot_um for f in lens.summary().fields]
    assert radii["c1"][0] == pytest.approx(41.5, abs=0.1)
    assert radii["c2"][0] == pytest.approx(31.48, abs=0.02)
    alone = copy.deepcopy(of_states["c2"])
    alone.wavelengths, alone.wavelength_weights = alone.wavelengths[1:2], None
    assert radii["c2"] == pytest.approx([f.rms_spot_um for f in alone.summary().fields])
    # In a merit of both states each has the spots, and the weights, that are its own.
    settings = MeritSettings(sampling_options={"rings": 3, "arms": 6})
    merit = settings.build(lens, DesignVariables(lens, {"surfaces.1.curvature": None}))
    for name, there in of_states.items():
        part, own = merit.parts[name].quality, settings.image_quality(there)
        torch.testing.assert_close(part.weights, 0.5 * own.weights)
    assert part.spots.wavelengths.tolist() == [587.6]
    assert part.spots.fields.tolist() == [[0.0, 5.0]]
    assert merit.parts["c1"].quality.weights.tolist() == pytest.approx(
        [w * f / 32 for f in (1, 3) for w in (1, 2, 1)]
    )


def test_drawn_lenses_are_traced_by_the_spots_that_count(triplet):
    """Tables of sensitivities name the others too."""

    def analysed(fields, waves, weights):
        lens = weighted(triplet, WAVES, (0, 1, 0))
        module = TolerancesModule(
            *(lens, Spots(fields, waves, PupilRays(2, 6)), weights),
            *({"surfaces.*.curvature": {"half_range": 1e-4}}, 1.0),
            *(MonteCarlo(4, None, 0), [20.0]),
        )
        numbers = module.analyse()
        del numbers["cost/lenses_per_s"]
        return numbers, {name: list(rows) for name, rows in module.tables().items()}

    numbers, tables = analysed(FIELDS, WAVES, [1.0, 0.0])
    wanted, alone = analysed(FIELDS[:1], [MIDDLE], [1.0])
    assert numbers == pytest.approx(wanted, rel=1e-9)
    assert numbers["cost/rays"] == 4 * 12
    for name in ("worst_offenders", "monte_carlo"):
        for row, other in zip(tables[name], alone[name], strict=True):
            assert row == {
                key: pytest.approx(value, rel=1e-6, abs=1e-12)
                if isinstance(value, float)
                else value
                for key, value in other.items()
            }
    assert len(tables["sensitivities"]) == 6 * len(alone["sensitivities"])
