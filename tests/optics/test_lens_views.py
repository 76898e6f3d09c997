"""What a lens shows of itself."""

import re
import subprocess
import sys

import pytest
import torch
from matplotlib.figure import Figure

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.errors import InputError
from dolens.lens_page.tables import first_order_table
from dolens.prescriptions import lens_from_prescription

SINGLET = {
    "name": "<script>alert(1)</script> \x1b[31m$x$",
    "stop": 1,
    "wavelengths": [550.0],
    "fields": {"heights": [[0, 0], [0, 2]]},
    "object_distance": 200.0,
    "elements": {"glass": {"surfaces": [1, 2], "tilt_x": 1.5}},
    "surfaces": {
        "1": {"type": "even_asphere", "radius": 30.0, "conic": -0.5, "a4": 1e-6, "a6": 0.0,
              "semi_diameter": 2.0, "thickness": 3.0, "material": "N-BK7"},
        "2": {"type": "sphere", "radius": -30.0, "semi_diameter": 3.0, "material": "air"},
    },
    "sensor": {"distance": 34.0, "diameter": 2.0},
}  # fmt: skip


@pytest.fixture
def singlet():
    return lens_from_prescription(SINGLET)


def test_repr_is_the_prescription(singlet):
    text = repr(singlet)
    lines = text.splitlines()
    assert lines[1].split()[:4] == ["surface", "type", "radius", "(mm)"]
    assert lines[2].split() == ["object", "200", "air"]
    assert lines[3].split() == ["1", "(stop)", "even_asphere", "30", "3", "SCHOTT:N-BK7", "2",
                                "-0.5", "a4"]  # fmt: skip
    assert lines[4].split() == ["2", "sphere", "-30", "34", "air", "3"]
    assert lines[5].split() == ["sensor", "plane", "1"]
    assert lines[6] == "element glass (surfaces 1 to 2): tilt_x 1.5°"
    assert "\x1b" not in text


def test_a_surface_shows_the_innermost_of_the_elements_that_carry_it():
    inner = {"front": {"surfaces": [1, 1], "decenter_x": 0.1}}
    for elements in ({**SINGLET["elements"], **inner}, {**inner, **SINGLET["elements"]}):
        table = lens_from_prescription({**SINGLET, "elements": elements}).prescription()
        assert [row.element for row in table.surfaces][:2] == ["front", "glass"]
        notes = "\n".join(table.notes)
        assert "element front (surfaces 1 to 1): decenter_x 0.1 mm" in notes
        assert "element glass (surfaces 1 to 2): tilt_x 1.5°" in notes


def test_the_table_follows_the_lens(singlet):
    with torch.no_grad():
        singlet.surfaces["2"].curvature.zero_()
    table = singlet.prescription()
    assert [row.radius for row in table.surfaces] == pytest.approx([30.0, float("inf")])
    assert table.surfaces[0].terms == {"a4": pytest.approx(1e-6), "a6": 0.0}
    assert table.surfaces[0].index_d == pytest.approx(1.5168, abs=1e-4)
    assert table.surfaces[0].abbe_number == pytest.approx(64.2, abs=0.1)
    assert (table.object_distance, table.sensor_distance) == (200.0, 34.0)


def test_html_escapes_what_a_file_says(singlet):
    for html in (singlet._repr_html_(), singlet.summary()._repr_html_()):
        assert "<script>" not in html and "&lt;script&gt;" in html and "\x1b" not in html
    assert "−30" in singlet._repr_html_()


def test_summary_holds_the_numbers_and_writes_them(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    found = lens.summary(fields=[0, 14])
    first = lens.first_order()
    assert found.efl == pytest.approx(float(first.efl.detach()))
    assert found.total_track == pytest.approx(60.177) and found.defocus == pytest.approx(
        -0.2251, abs=1e-4
    )
    assert (found.front_principal_z, found.rear_principal_z) == pytest.approx(
        (float(first.front_principal.detach()), float(first.rear_principal.detach()))
    )
    assert [row.field for row in found.fields] == [(0.0, 0.0), (0.0, 14.0)]
    sums = lens.seidel(14.0)
    assert found.seidel["coma"] == pytest.approx(float(sums.total.coma.detach()))
    assert len(found.seidel_by_surface) == 6
    text = repr(found)
    assert "effective focal length" in text and "50.019" in text and "S_III" in text
    assert found._repr_html_().count("<table>") == 3


def test_a_notebook_and_a_page_show_the_same_quantities(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml", torch.float64)
    page = first_order_table(lens, conditions(lens))
    shown = lens.summary().first_order_cells()
    assert [(name, unit) for name, _, unit in page.rows] == [
        (name, unit) for name, _, unit in shown
    ]
    for (_, theirs, _), (_, ours, _) in zip(page.rows, shown, strict=True):
        assert float(theirs.replace("−", "-")) == float(ours)


def test_summary_of_a_lens_without_light_says_so(root):
    found = load_lens(root / "conf/lens/cooke_triplet.yaml").summary(fields=[0, 45])
    assert "no light" in repr(found)


METHODS = (
    "draw", "spots", "ray_fans", "mtf", "field_curves", "lateral_colour", "rms",
    "encircled_energy", "relative_illumination", "psf", "wavefront", "zernike", "strehl",
    "footprint",
)  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
def test_figures_of_a_near_object_name_lens_aperture_and_wavelength(singlet, method):
    figure = getattr(singlet, method)(f_number=10.0)
    assert isinstance(figure, Figure)
    title = figure.get_suptitle() or figure.axes[0].get_title()
    assert "F/11" in title and "550" in title and "200 mm" in title
    assert r"\$x\$" in title and "\x1b" not in title
    for axes in figure.axes:
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            assert not re.search(r"-\d", label)
    # A picture that a notebook can show without pyplot.
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert singlet.surfaces["1"].semi_diameter == 2.0


@pytest.mark.parametrize("method", ["summary", *METHODS])
def test_an_argument_that_a_method_does_not_have_is_named_with_the_method(singlet, method):
    with pytest.raises(InputError, match=rf"^{method}\(\): unknown key 'num_rays'.*f_number"):
        getattr(singlet, method)(num_rays=5)


def test_wrong_options_are_named(singlet):
    with pytest.raises(InputError, match="did you mean 'rays'"):
        singlet.draw(num_rays=5)
    with pytest.raises(InputError, match="f_number"):
        singlet.spots(f_numbre=4.0)
    with pytest.raises(InputError, match="object_distance"):
        singlet.draw(object_distance=-1.0)
    with pytest.raises(InputError, match=r"kind: 'fft' .*fourier, huygens"):
        singlet.psf(kind="fft")
    with pytest.raises(InputError, match=r"order: 'noll' .*fringe, standard"):
        singlet.zernike(order="noll")


def test_pyplot_knows_nothing_and_ipython_shows_a_figure_once(root):
    code = f"""
import sys
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance()
from dolens import load_lens
from dolens.analysis.conditions import conditions
lens = load_lens({str(root / "conf/lens/cooke_triplet.yaml")!r})
figure = lens.draw()
assert "matplotlib.pyplot" not in sys.modules
data, _ = shell.display_formatter.format(figure)
assert sorted(data) == ["image/png", "text/plain"], sorted(data)
data, _ = shell.display_formatter.format(lens)
assert sorted(data) == ["text/html", "text/plain"], sorted(data)
import matplotlib
matplotlib.use("agg")
import matplotlib.pyplot as plt
assert plt.get_fignums() == []
from IPython.core.pylabtools import select_figure_formats
select_figure_formats(shell, {{"png"}})
data, _ = shell.display_formatter.format(figure)
assert sorted(data) == ["image/png", "text/plain"], sorted(data)
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
