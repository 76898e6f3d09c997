"""The short way in Python: what one call gives is what the commands give, and examples are true."""

import copy
import doctest
import importlib
import re

import pytest
import torch

import dolens
from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions
from dolens.lens_page.offenders import offenders
from dolens.lens_page.overview import prepared_lens
from dolens.optics import LENS_METHODS
from dolens.optics.lens import Lens
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritSettings


def examples():
    """Doctests of the methods of `Lens` and of the functions of `dolens`, by name."""
    found = {name: getattr(Lens, name) for name in LENS_METHODS}
    found |= {name: getattr(dolens, name) for name in dolens.__all__}
    for name, each in found.items():
        for test in doctest.DocTestFinder(recurse=False).find(each, name, globs={"dolens": dolens}):
            if test.examples:
                yield pytest.param(test, id=name)


@pytest.mark.parametrize("test", list(examples()))
def test_the_example_of_a_docstring_is_true(test):
    said = []
    done = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(
        test, out=said.append
    )
    assert done.attempted and not done.failed, "".join(said)


@pytest.mark.parametrize("name", ["", ".optimize", ".rendering", ".reconstruction"])
def test_dir_shows_public_names_alone_and_each_is_there(name):
    module = importlib.import_module(f"dolens{name}")
    shown = dir(module)
    assert set(module.__all__) <= set(shown) and all(hasattr(module, one) for one in shown)
    assert not [one for one in shown if one.startswith("_") and one != "__version__"]


# ---------------------------------------------------------------- optimize

NIKON = (
    *("surfaces.[1-9].curvature", "surfaces.1[013-9].curvature", "surfaces.20.curvature"),
    *("surfaces.1[78].conic", "surfaces.1[78].a4"),
)
KEPT = {
    **{"efl": 1.5736, "edge_thickness": (0.03, None), "edge_air_gap": (0.005, None)},
    **{"centre_thickness": (0.01, None), "air_gap": (0.001, None)},
}


def nikon_from_spheres():
    lens = load_lens("nikon", index_model="do")
    with torch.no_grad():
        for parameter in lens.variables(["surfaces.1[78].a*", "surfaces.1[78].conic"]).values():
            parameter.zero_()
    return lens


def test_one_call_reaches_the_merit_of_the_experiment_of_the_same_settings():
    """As conf/experiment/nikon.yaml has them: six iterations by hand, and by `optimize`."""
    lens = nikon_from_spheres()
    before = copy.deepcopy(lens.state_dict())
    better = lens.optimize(NIKON, keep=KEPT, iterations=6, sampling="square_grid")
    operands = [
        {"kind": "efl", "target": 1.5736, "weight": 100.0},
        {"kind": "edge_thickness", "min": 0.03, "weight": 100.0},
        {"kind": "edge_air_gap", "min": 0.005, "weight": 100.0},
        {"kind": "centre_thickness", "min": 0.01, "weight": 100.0},
        {"kind": "air_gap", "min": 0.001, "weight": 100.0},
    ]
    settings = MeritSettings(sampling="square_grid", operands=operands)
    variables = DesignVariables(lens, dict.fromkeys(NIKON))
    merit = settings.build(lens, variables)
    optimizer = DampedLeastSquares([variables.parameter_group()], merit_tolerance=1e-9)
    by_hand = [merit().sum_of_squares(), *(float(optimizer.step(merit)) for _ in range(6))]
    record = better.optimization
    assert record.merit == tuple(by_hand)
    assert all(torch.equal(value, before[name]) for name, value in lens.state_dict().items())
    assert lens.optimization is None
    # What is kept of the rounds is the merit over the rays that pass the lens that was found.
    variables.write_to(lens)
    assert record.reached == settings.build(lens, variables)().sum_of_squares()
    for name, value in variables.file_values().items():
        assert better.get_parameter(name).item() == value


def test_a_singlet_is_bent_to_its_least_spherical_aberration():
    """Coddington's shape factor 2(n² - 1)/(n + 2) of a thin lens, for an object at infinity."""
    lens = dolens.load_lens("lb1757")
    with torch.no_grad():
        lens.thicknesses["1"].fill_(0.1)
        lens.surfaces["1"].curvature.fill_(0.02)
        lens.surfaces["2"].curvature.fill_(-0.02)
    focal = lens.first_order(587.5618).efl.item()
    better = lens.optimize(
        {"surfaces.*.curvature": None, "sensor_distance": {"solve": "best_focus"}},
        keep={"efl": {"target": focal, "weight": 1e4}},
        fields=0.0,
        wavelengths=587.5618,
        sampling_options={"rings": 6},
        max_vignetting=1.0,
    )
    first, second = (float(better.surfaces[n].curvature) for n in "12")
    index = float(lens.materials[1].index(torch.tensor(587.5618, dtype=torch.float64)))
    shape = (first + second) / (first - second)
    assert shape == pytest.approx(2.0 * (index**2 - 1.0) / (index + 2.0), rel=0.03)
    assert float(better.first_order(587.5618).efl) == pytest.approx(focal, rel=1e-4)


def test_a_record_shows_operands_bounds_and_what_nothing_kept():
    lens = load_lens("cooke_triplet")
    better = lens.optimize(
        {"surfaces.*.curvature": None, "thicknesses.*": {"lower": 1.0, "upper": 6.5}},
        keep={"efl": 50, "back_focus": (30, None), "distortion": (-2, 2)},
        iterations=20,
    )
    record = better.optimization
    assert "thicknesses.3" in record.at_bounds
    kept = {one.label: one for one in record.operands}
    assert {"efl", "bfd", "distortion/0,20"} <= set(kept)
    assert kept["efl"].after == pytest.approx(float(better.first_order().efl))
    assert kept["bfd"].deviation == 0.0 and kept["bfd"].wanted == "at least 30"
    text, page = repr(record), record._repr_html_()
    for part in ("Cooke triplet: RMS spot radius", "at its bound 1", "at least 30", "-2 to 2"):
        assert part.replace("-", "−") in page.replace("-", "−") and part in text
    assert record.figure()._repr_png_() and record.draw()._repr_png_()
    assert copy.deepcopy(better).optimization is record


def test_glass_stays_above_half_of_the_thinnest_unless_it_may_go_anywhere():
    lens = load_lens("cooke_triplet")
    short = {"total_track": 57.0}
    thin = lens.optimize(["thicknesses.3"], keep=short, iterations=10)
    assert thin.thicknesses["3"].item() == pytest.approx(0.5, abs=0.05)
    (bound,) = (one for one in thin.optimization.operands if one.label.startswith("centre"))
    assert (bound.label, bound.wanted) == ("centre_thickness/3", "at least 0.5")
    anywhere = {"centre_thickness": (-99, None), "edge_thickness": (-99, None)}
    through = lens.optimize(["thicknesses.3"], keep=short | anywhere, iterations=10)
    assert through.optimization.notes[0].startswith("centre_thickness/3 is -")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"variables": []}, "variables: there are none"),
        ({"variables": ["surface.*.curvature"]}, "has no parameter 'surface"),
        ({"variables": 3}, r"variables: 3; allowed: names or patterns"),
        ({"for_": "spot"}, "for_: 'spot' is unknown; did you mean 'spots'"),
        ({"keep": {"elf": 50}}, "keep: 'elf' is unknown; did you mean 'efl'"),
        ({"keep": {"efl": "50mm"}}, "keep: efl: '50mm'; allowed: a number"),
        ({"keep": {"efl": (60, 50)}}, "keep: operand 'efl': min exceeds max"),
        ({"keep": {"bfd": 40, "back_focus": 40}}, "keep: 'back_focus' is named twice"),
        ({"iterations": 0}, "iterations: 0; allowed: an integer of 1 or more"),
        ({"field": 3}, r"optimize\(\): unknown key 'field'; did you mean 'fields'"),
        ({"wavelengths": "red"}, "wavelengths must be numbers"),
    ],
)
def test_what_cannot_be_optimized_is_refused_in_one_line(given, message):
    lens = load_lens("cooke_triplet")
    with pytest.raises(InputError, match=message):
        lens.optimize(**{"variables": ["surfaces.1.curvature"], **given})


# ---------------------------------------------------------------- drafts


def curves(figure):
    """Contrast of the panel with diffraction, or of the only one: label → values."""
    return {
        line.get_label().replace(" (rays alone)", ""): torch.tensor(line.get_ydata())
        for line in figure.axes[0].lines
    }


def radii(figure):
    """RMS radii in the headings of a spot diagram, µm."""
    headings = [axes.get_title() for axes in figure.axes]
    return torch.tensor([float(re.search(r"RMS ([\d.]+)", text)[1]) for text in headings])


# Of the triplet all fields diffract; of the others' rays take the place of diffraction.
@pytest.mark.parametrize(
    ("name", "of_contrast", "of_radius"),
    [("cooke_triplet", 1e-9, 6e-3), ("double_gauss", 0.05, 0.03), ("lb1757", 0.03, 0.03)],
)
def test_a_draft_is_as_close_to_the_exact_figure_as_its_docstring_says(
    name, of_contrast, of_radius
):
    lens = load_lens(name)
    for what, most in (({"geometric": False}, of_contrast), ({"diffraction": False}, 0.05)):
        exact, draft = (curves(lens.mtf(draft=how, **what)) for how in (False, True))
        assert exact.keys() == draft.keys() and len(exact) > 3
        for label, curve in exact.items():
            assert float((curve - draft[label]).abs().max()) <= most
    exact, draft = radii(lens.spots()), radii(lens.spots(draft=True))
    assert float((draft / exact - 1.0).abs().max()) <= of_radius
    assert lens.backend == "auto"


@pytest.mark.parametrize("method", ["spots", "mtf"])
def test_a_figure_says_whether_it_is_a_draft(method):
    lens = load_lens("cooke_triplet")
    for draft in (False, True):
        figure = getattr(lens, method)(draft=draft)
        assert figure.draft is draft and ("(draft)" in figure.get_suptitle()) is draft
    with pytest.raises(InputError, match=r"draft: True with kind 'huygens'; allowed: .*'fourier'"):
        lens.mtf(kind="huygens", draft=True)


# ---------------------------------------------------------------- tolerances


def test_tolerances_are_those_of_the_page_and_the_yield_that_of_traced_lenses():
    lens = load_lens("cooke_triplet")
    made = lens.tolerances("default", lenses=400, seed=1)
    shown = prepared_lens(lens)
    page = offenders(shown, conditions(shown), "default")
    assert made.table().rows == page.table().rows
    assert made.offenders.summary() == page.summary()
    # A lens that no drawn error has moved is the design; and the model predicts the traced mean.
    radii = made.radii_um()
    assert made.nominal_um == pytest.approx(1e3 * page.contributions.nominal**0.5)
    assert float(radii.square().mean().sqrt()) == pytest.approx(made.expected_um, rel=0.02)
    assert made.yield_at(made.radius_of(0.9)) == pytest.approx(0.9)
    assert made.yield_at(0.0) == 0.0 and made.yield_at(1e3) == 1.0
    again = lens.tolerances("default", lenses=400, seed=1)
    assert torch.equal(again.radii_um(), radii)
    text, html = repr(made), made._repr_html_()
    assert "90 % of 400 lenses within" in text and "90 % of 400 lenses within" in html
    assert made.figure()._repr_png_() and made.offenders_figure()._repr_png_()


def test_half_ranges_are_given_as_a_mapping_and_a_tenth_of_them_does_a_hundredth():
    """The average rise of the mean square radius is quadratic in the tolerances."""
    lens = load_lens("cooke_triplet")
    rise = [
        found.expected_um**2 - found.nominal_um**2
        for factor in (1.0, 0.1)
        for found in [lens.tolerances({"elements.*.tilt_[xy]": 0.05 * factor}, lenses=10)]
    ]
    assert rise[1] == pytest.approx(rise[0] / 100.0, rel=1e-3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tolerances": "usual"}, "^tolerances: usual: cannot be read"),
        ({"tolerances": 3}, "tolerances: 3; allowed: 'default', a file, or pattern"),
        ({"tolerances": {}}, "tolerances: none is given"),
        ({"tolerances": {"thickness.*": 0.1}}, "has no parameter 'thickness"),
        ({"lenses": 0}, "lenses: 0; allowed: an integer of 1 or more"),
        ({"seed": 0.5}, "seed: 0.5; allowed: an integer of 0 or more"),
        ({"fnumber": 8}, r"tolerances\(\): unknown key 'fnumber'; did you mean 'f_number'"),
    ],
)
def test_what_cannot_be_toleranced_is_refused_in_one_line(given, message):
    with pytest.raises(InputError, match=message):
        load_lens("cooke_triplet").tolerances(**given)
