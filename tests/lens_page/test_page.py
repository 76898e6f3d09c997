"""A page says everything that can be said about a lens, and needs nothing else."""

import json
import math

import pytest
import torch

from dolens import InputError, load_lens
from dolens.lens_page.overview import lens_overview, prepared_lens
from dolens.lens_page.page import _with_few_fields, is_page
from tests.lens_page.conftest import HOSTILE

SECTIONS = [
    *("Section", "In space", "Prescription", "First-order data", "Seidel sums", "RMS spot radii"),
    *("Spot diagram", "Ray fans", "MTF", "Point spread functions"),
    *("RMS against field and wavelength", "Encircled energy", "Field curvature and distortion"),
    *("Lateral colour and focal shift", "Relative illumination", "Wavefront error"),
    *("Footprints", "Tolerances"),
]


def test_every_section_is_there_and_in_the_contents(parsed, page):
    assert parsed.titles == SECTIONS
    assert page[1].sections == len(SECTIONS)
    links = [link for link in parsed.links if link.startswith("#")]
    assert len([link for link in links if link[1:] in parsed.ids]) >= len(SECTIONS)
    assert len(set(parsed.ids)) == len(parsed.ids)


def test_nothing_is_fetched(parsed, page):
    text = page[0].read_text(encoding="utf-8")
    assert "http:" not in text and "https:" not in text and "@import" not in text
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in parsed.links)
    # url() of a style or a drawing leads to a part of the same page only.
    assert text.count("url(") == text.count("url(#")
    assert page[0].stat().st_size < 3e6


def test_names_of_a_file_are_text_and_never_markup(parsed, page):
    text = page[0].read_text(encoding="utf-8")
    assert HOSTILE not in text
    assert "".join(parsed.text).count(HOSTILE) >= 2
    # The data of the viewer, and its program.
    assert len(parsed.named["script"]) == 2
    assert "onload" not in text


def test_the_data_of_the_view_in_space_are_whole(page):
    text = page[0].read_text(encoding="utf-8")
    start = text.index('id="viewer-data">') + len('id="viewer-data">')
    data = json.loads(text[start : text.index("</script>", start)])
    kinds = [mesh["kind"] for mesh in data["meshes"]]
    assert kinds.count("glass") == 2
    assert {"side", "cap", "stop", "sensor"} <= set(kinds)
    rays = [len(field["rays"]) for field in data["fields"]]
    assert rays[0] > 8 and rays[1] > 8 and rays[2] == 0


def test_a_field_that_no_ray_passes_is_named_and_stops_nothing(parsed, page):
    text = "".join(parsed.text)
    assert "no light passes" in text
    assert "40° (no ray passes)" in text
    titles = {title for title, _ in page[1].problems}
    assert titles <= {"MTF", "Point spread functions", "Tolerances"}
    assert not any("Error" in problem for _, problem in page[1].problems)


def test_the_tables_say_the_lens_and_the_aperture_asked_for(parsed):
    cells = {row[0]: row[1] for table in parsed.tables[::-1] for row in table if len(row) > 1}
    # Lensmaker's equation for R = 20 and -50 mm, 5 mm of glass of n = 1.5168.
    n, a, b, t = 1.5168, 20.0, -50.0, 5.0
    power = (n - 1.0) * (1.0 / a - 1.0 / b + (n - 1.0) * t / (n * a * b))
    assert math.isclose(float(cells["effective focal length"]), 1.0 / power, rel_tol=1e-5)
    assert math.isclose(float(cells["F-number"]), 4.0, rel_tol=1e-5)
    assert cells["2"] == "even asphere (stop)"


def test_every_figure_is_written_as_png_and_svg(page):
    folder = page[0].parent / "figures"
    names = {path.stem for path in folder.glob("*.svg")}
    assert names == {path.stem for path in folder.glob("*.png")}
    assert len(names) == page[1].figures
    assert {"section", "spots", "mtf", "psf", "worst_offenders"} <= names


def test_a_page_is_known_as_one(page, tmp_path):
    assert is_page(page[0])
    other = tmp_path / "mine.html"
    other.write_text("<html></html>")
    assert not is_page(other)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"fields": [[0, 95]]}, "fields must be within ±90 degrees"),
        ({"wavelengths": [0.55]}, "wavelength 0.55 nm: allowed: 50 nm to 10 mm"),
        ({"wavelengths": [550, 550]}, "wavelengths: one is given twice"),
        ({"f_number": 4.0, "entrance_pupil_diameter": 3.0}, "not both"),
        ({"f_number": -2.0}, "f_number must be positive"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_options_that_make_no_sense(options, said, hostile_lens):
    with pytest.raises(InputError, match=said.replace("(", r"\(")):
        prepared_lens(hostile_lens, **options)


def test_a_lens_is_prepared_without_changing_it(root):
    lens = load_lens(root / "conf/lens/double_gauss.yaml", torch.float32)
    shown = prepared_lens(lens, [[0, 10]], [500, 550, 600], entrance_pupil_diameter=20.0)
    assert (lens.dtype, lens.wavelengths[0]) == (torch.float32, 656.2725)
    assert shown.dtype == torch.float64
    assert shown.reference_wavelength == 550
    assert shown.fields.points == ((0.0, 10.0),)
    pupil = shown.first_order(550).entrance_pupil.diameter
    assert math.isclose(float(pupil), 20.0, rel_tol=1e-9)


def test_figures_of_many_fields_show_nine_from_the_axis_to_the_edge():
    lens = prepared_lens(load_lens("cooke_triplet"), [(0.0, 0.6 * n) for n in range(34)])
    overview = lens_overview(lens)
    few, about = _with_few_fields(lens, overview)
    assert len(overview.conditions.fields) == 34 and len(about.conditions.fields) == 9
    angles = about.conditions.fields[:, 1].tolist()
    assert angles[0] == 0.0 and angles[-1] == pytest.approx(19.8) and angles == sorted(angles)
    assert len(few.fields.points) == 9
    assert _with_few_fields(few, about) == (few, about)  # few enough
    # Where none of the nine has a weight they count alike.
    lens.fields = lens.fields._replace(weights=tuple(float(n == 2) for n in range(34)))
    _, about = _with_few_fields(lens, overview)
    assert about.conditions.field_weights.tolist() == pytest.approx([1.0 / 9.0] * 9)
