"""Designs of others are read as meant, from a file of a closed form that the test writes."""

import itertools
import math
from pathlib import Path

import pytest
import torch
import yaml

from dolens.errors import InputError
from dolens.optics.rays import Rays
from scripts.designs.files import design_files, read_design
from scripts.designs.glass import HartmannGlass
from scripts.designs.lenses import beams, lens_of, measures
from scripts.designs.redesign import (
    kept,
    least_squares,
    limits_of,
    redesigned,
    start_of,
    their_rule,
    variables_of,
)
from scripts.designs.tables import check_row, redesign_table

_INDEX = 1.5
_CURVATURES = (0.05, -0.02)
_THICKNESS, _STOP, _BACK = 2.0, 0.5, 27.0


def written(folder: Path, lens: dict | None = None, light: dict | None = None) -> Path:
    """Write a singlet behind a stop, with glass that hardly disperses, and its specification."""
    arguments = {
        "lens_sequence": "s-aRa-",
        "a": [[0.0, 1e-5], [0.0, 0.0]],
        "c": list(_CURVATURES),
        "d": [],
        "m": [],
        "nd": [_INDEX],
        "vd": ["1e9"],
        "s": [_STOP, _THICKNESS, _BACK],
        "nominal_wavelength": 550.0,
        "target_efl": 29.0,
        "solve_idx": -1,
        "freeze": {
            "s": {"default": False, "toggle_row_col_list": [-1]},
            "c": {"default": False, "toggle_row_col_list": [-1]},
        },
        **(lens or {}),
    }
    specification = {
        "aperture_type": "epd",
        "aperture": 4.0,
        "hfov": 5.0,
        "n_fields": 3,
        "wavelengths": [500.0, 550.0],
        "wavelength_weights": [1.0, 3.0],
        **(light or {}),
    }
    paths = {
        "class_path": "x.RayPathResiduals",
        "init_args": {"min_cutoff": 0.1, "min_cutoff_refractive": 0.5, "max_cutoff_refractive": 4},
    }
    (folder / "one" / "designs").mkdir(parents=True)
    model = {"ray_initialization": {"init_args": specification}, "residuals": [paths]}
    (folder / "one" / "defaults.yml").write_text(yaml.safe_dump({"model": model}))
    path = folder / "one" / "designs" / "singlet_spot.yml"
    design = {"model": {"lens_parameterization": {"init_args": arguments}}}
    path.write_text(yaml.safe_dump(design))
    return path


def lensmaker() -> float:
    """Return the focal length of the thick singlet, mm."""
    first, second = _CURVATURES
    bending = first - second + (_INDEX - 1.0) * _THICKNESS * first * second / _INDEX
    return 1.0 / ((_INDEX - 1.0) * bending)


def test_a_singlet_has_the_focal_length_of_the_lensmaker(tmp_path):
    path = written(tmp_path)
    assert design_files(tmp_path) == [path]
    design = read_design(path)
    found = measures(lens_of(design), design)
    assert found.efl == pytest.approx(lensmaker(), rel=1e-8)
    assert found.f_number == pytest.approx(lensmaker() / 4.0, rel=1e-8)
    assert found.track == pytest.approx(_THICKNESS + _BACK)
    assert found.total == pytest.approx(_STOP + _THICKNESS + _BACK)
    assert found.back == pytest.approx(_BACK)
    assert found.glass[:2] == pytest.approx((_THICKNESS, _THICKNESS))
    assert "singlet_spot" in check_row(design, found)


def test_the_sag_is_a_conic_and_even_powers_from_the_fourth_on(tmp_path):
    design = read_design(written(tmp_path))
    lens = lens_of(design)
    ray = Rays(torch.tensor([[0.0, 1.5, -1.0]]).double(), torch.tensor([[0.0, 0.0, 1.0]]), 550.0)
    height = float(lens.trace(ray, record=True).points[1, 0, 2].detach())
    curvature = _CURVATURES[0]
    conic = curvature * 1.5**2 / (1.0 + math.sqrt(1.0 - (curvature * 1.5) ** 2))
    assert height == pytest.approx(_STOP + conic + 1e-5 * 1.5**4, abs=1e-10)


def test_hartmann_s_glass_has_the_three_numbers_that_name_it():
    glass = HartmannGlass.of(1.7, 30.0, 0.01)
    d, f, c, g = (glass.index(nm) for nm in (587.6, 486.1, 656.3, 435.8))
    assert d == pytest.approx(1.7, abs=1e-12)
    assert (d - 1.0) / (f - c) == pytest.approx(30.0)
    assert (g - f) / (f - c) == pytest.approx(0.6438 - 0.001682 * 30.0 + 0.01)


def test_a_field_stop_leaves_the_upper_part_of_a_pupil(tmp_path):
    """A stop as wide as the pupil, 0.5 mm in front of it, cuts 0.5·tan θ off at one side."""
    word = {"lens_sequence": "R-s-", "a": [], "s": [_THICKNESS, 1.0, _BACK]}
    design = read_design(written(tmp_path, word, {"field_stop_position": 0.0}))
    lens = lens_of(design)
    first = lens.first_order(550.0).entrance_pupil
    rays = beams(lens, design, rings=1, arms=40)
    edge = rays.rays.position[rays.spot == 4], rays.rays.direction[rays.spot == 4]
    at = edge[0] + edge[1] * ((float(first.z) - edge[0][:, 2:]) / edge[1][:, 2:])
    lost = float(first.z) * math.tan(math.radians(5.0))
    assert float(at[:, 1].max()) == pytest.approx(2.0, abs=0.01)
    assert float(at[:, 1].min()) == pytest.approx(-2.0 + lost, abs=0.01)
    share = (1.0 - lost / 4.0) * (1.0 - lost / 8.0)
    assert float(rays.light[4]) == pytest.approx(share)


def metasurface(row: list[float], bezier: bool) -> dict:
    model = {"normalization_radius": 4.0, "bezier_parameterization": bezier}
    return {
        "lens_sequence": "s-m-",
        "c": [],
        "a": [],
        "m": [row],
        "nd": [],
        "vd": [],
        "s": [1.0, 50.0],
        "solve_idx": None,
        "misc_surface_model": {
            "class_path": "x.DispersionEngineeredMetasurface",
            "init_args": model,
        },
    }


@pytest.mark.parametrize("bezier", [False, True])
def test_a_metasurface_focuses_by_its_quadratic_phase(tmp_path, bezier):
    """A phase -π r²/(λf) has the focal length f; Bernstein's polynomials sum to one."""
    strength = -math.pi * 4.0**2 / (550e-6 * 50.0)
    row = [strength, strength if bezier else 0.0, 0.0, 0.0]
    design = read_design(written(tmp_path, metasurface(row, bezier)))
    terms, radius = design.surfaces[1].phase
    assert radius == 4.0
    assert terms == pytest.approx((strength, 0.0))
    assert float(lens_of(design).first_order(550.0).efl) == pytest.approx(50.0)


def test_a_metasurface_whose_phase_goes_with_wavelength_is_refused(tmp_path):
    with pytest.raises(InputError, match="goes with 1/λ"):
        read_design(written(tmp_path, metasurface([-1.0, 0.0, 3.0, 0.0], False)))


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (
            {"lens_sequence": "s-m-aRa-", "s": [1.0, 1.0, 2.0, 27.0]},
            "m: 0; allowed for s-m-aRa-: 1",
        ),
        ({"lens_sequence": "s-d-aRa-"}, "diffractive"),
        ({"lens_sequence": "s-aRa-R-"}, "c: 2; allowed for s-aRa-R-: 4"),
        ({"lens_sequence": "aRa-"}, "0 stops"),
        ({"lens_sequence": "s-aQa-"}, "'Q'"),
        ({"target_efl": None}, "target_efl"),
    ],
)
def test_what_is_not_held_is_refused_with_its_reason(tmp_path, lens, message):
    with pytest.raises(InputError, match=message):
        read_design(written(tmp_path, lens))


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="has no"):
        design_files(tmp_path)


def test_a_start_keeps_the_focal_length_and_what_the_file_holds(tmp_path):
    design = read_design(written(tmp_path))
    lens = lens_of(design)
    published = measures(lens, design)
    assert kept(published, published, design) == []
    names = variables_of(design, lens, published)
    assert "sensor_distance" not in names  # its space is held
    assert names["surfaces.3.curvature"] == {"solve": "efl", "target": published.efl}
    thick = {e["kind"]: e for e in limits_of(design, published)}["centre_thickness"]
    assert thick["min"] == pytest.approx(0.5, abs=2e-3)
    start, away = start_of(design, published)
    assert away > 0.0
    assert float(start.first_order(550.0).efl) == pytest.approx(published.efl)
    assert float(start.sensor_distance) == pytest.approx(_BACK)


@pytest.mark.parametrize("rule", ["dolens", "theirs"])
def test_a_redesign_sharpens_a_singlet_within_its_limits(tmp_path, rule):
    design = read_design(written(tmp_path))
    lens = lens_of(design)
    published = measures(lens, design)
    theirs, ticks = {"lm_parameter": 1.0, "tolerance": 1.0}, itertools.count()
    made = redesigned(
        lens,
        design,
        published,
        40.0,
        least_squares if rule == "dolens" else lambda v: their_rule(v, theirs),
        rounds=2,
        clock=lambda: float(next(ticks)),
    )
    assert made.broken == []
    assert made.measures.mean < 0.9 * published.mean
    assert made.measures.efl == pytest.approx(published.efl)


def test_only_lenses_that_keep_their_limits_count():
    found = [
        {
            "name": n,
            "published": 2.0,
            "start": 9.0,
            "away": 0.1,
            **{
                way: {"mean": mean, "broken": broken, "steps": 5}
                for way in ("from_published", "from_start", "their_rule")
            },
        }
        for n, mean, broken in (("a", 1.9, []), ("b", 1.9, ["air"]), ("c", 2.1, []))
    ]
    lines = redesign_table(found)
    assert "1 of 3 from there, 1 by dolens" in lines[-1]
    assert "| b | 2.000 | 1.900 (air) | 9.0 (10 %) |" in lines[3]
