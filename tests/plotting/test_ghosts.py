"""What a lens shows of its ghosts: the ranked table, the section of a path, the map."""

import math

import numpy as np
import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.ghost_map import ghost_map
from dolens.optics.text_tables import measured
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.lenses import lens_of_rows


@pytest.fixture(scope="module")
def triplet():
    return load_lens("cooke_triplet").requires_grad_(False)


@pytest.fixture(scope="module")
def shown(triplet):
    return triplet.ghosts(field=14.0, rays=2000)


def test_the_brightest_ghost_comes_first_and_says_how_wrong_it_is(shown):
    heading, heads, first, *rest = repr(shown).splitlines()
    assert heading.startswith("Cooke triplet: 15 ghosts of a source at 14°, 587.562 nm")
    assert heads.split()[:2] == ["reflected", "at"]
    assert first.startswith("6 → 1") and " ± " in first and first.endswith("air|1.6204/60.31")
    bright = shown.found.measures.irradiance.tolist()
    assert bright == sorted(bright, reverse=True)
    assert len(rest) == 15  # the others, and the note


def test_ghosts_without_light_are_counted_and_not_listed():
    one = load_lens("double_gauss").ghosts(field=(0.0, 35.0), rays=2000)
    rows = one.rows()
    dark = int((one.found.measures.share == 0.0).sum())
    assert dark > 0 and len(rows) == 45 - dark
    assert f"{dark} without light" in repr(one)
    assert "no image of it" in one.heading
    assert all(row[1] == "–" for row in rows)  # power over that of the image


def test_names_of_a_file_are_text_in_html():
    rows = ((40.0, 2.0, "1.5"), (-40.0, 0.0, "air"))
    lens = lens_of_rows(*rows, sensor=40.0, stop=1, name="<b>&")
    assert "&lt;b&gt;&amp;" in lens.ghosts(rays=100)._repr_html_()


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (12.673, 0.041, "12.67 ± 0.04"),
        (1.3041e-4, 7.2e-7, "(1.304 ± 0.007)e-4"),
        (-0.002, 0.06, "0.00 ± 0.06"),
        (9.96, 0.096, "10.0 ± 0.1"),
        (2.0, 0.0, "2"),
        (math.nan, 1.0, "–"),
        (0.0, 2e-7, "(0 ± 2)e-7"),
        (5e4, 300.0, "50000 ± 300"),
    ],
)
def test_a_value_has_the_digits_that_its_error_allows(value, error, text):
    assert measured(value, error) == text


@pytest.mark.parametrize("path", [(6, 1), (5, 4), (4, 2)])
def test_rays_of_a_ghost_turn_where_surfaces_are(triplet, shown, path):
    axes = shown.draw(path, rays=5).axes[0]
    lines = [line.get_xydata() for line in axes.lines if line.get_gid() == "ghost ray"]
    assert lines and len(lines) % 3 == 0
    onwards, back, last = (np.split(np.arange(len(lines)), 3)[leg] for leg in range(3))
    system = triplet.system()
    for one, two, three in zip(onwards, back, last, strict=True):
        for leg, next_leg, number in ((one, two, path[0]), (two, three, path[1])):
            assert np.array_equal(lines[leg][-1], lines[next_leg][0])
            z, y = lines[leg][-1]
            y = torch.tensor([y], dtype=torch.float64)
            sag = system.surfaces[number - 1].sag_and_slopes(torch.zeros_like(y), y)[0]
            assert abs(float(sag + system.vertices[number - 1]) - z) < 1e-9
        assert abs(lines[three][-1][0] - float(system.vertices[-1])) < 1e-9
    legend = [text.get_text() for text in axes.get_legend().get_texts()]
    ends = f"to surface {path[0]}", f"back to surface {path[1]}", "to the sensor"
    assert legend == [*ends]


def test_a_path_that_no_ray_passes_is_drawn_without_rays(triplet):
    axes = triplet.ghosts(field=60.0, rays=500).draw((6, 5)).axes[0]
    assert not [line for line in axes.lines if line.get_gid() == "ghost ray"]
    assert axes.get_legend().get_title().get_text() == "no ray arrives"


def test_a_path_that_is_none_is_refused(shown):
    with pytest.raises(InputError, match=r"ghost path \(1, 6\)"):
        shown.draw((1, 6))


def test_the_map_holds_the_light_of_the_table(triplet):
    """On a sensor that catches it all: power over the sensor, and the shift of a ghost."""
    given = prescription_of(triplet)
    del given["sensor"]["diameter"]
    lens = lens_from_prescription(given)
    paths = [(6, 1), (5, 4)]
    one = lens.ghosts(field=14.0, rays=20_000)
    chosen = [one.paths.index(path) for path in paths]
    area = lens.surfaces["1"].semi_diameter ** 2 * math.pi
    found = ghost_map(lens, one.found.where, rays=20_000, width=120.0, paths=paths)
    pixel = (120.0 / 64) ** 2
    light = float(found.irradiance.sum()) * pixel
    share = float(one.found.measures.share[chosen].sum())
    # The beam's cross-section in front of a curved surface is a little less than cos 14° of it.
    assert 0.94 < light / (share * area) < math.cos(math.radians(14.0)) + 0.01
    assert 0.0 < found.relative_error < 0.1
    y = (torch.arange(64, dtype=torch.float64) - 31.5) * 120.0 / 64
    centre = float((found.irradiance.sum(1) * y).sum() / found.irradiance.sum())
    shares = one.found.measures.share[chosen]
    wanted = float((one.found.measures.y[chosen] * shares).sum() / shares.sum())
    assert abs(centre - wanted) < 0.1


def test_maps_of_several_sources_have_one_scale(triplet, shown):
    figure = shown.map(rays=2000, pixels=16)
    pictures = [image for axes in figure.axes for image in axes.images if image.get_gid()]
    assert [image.get_array().shape for image in pictures] == [(16, 16)]
    assert figure.axes[0].get_title().startswith("source at 14°")
