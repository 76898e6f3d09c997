"""Numbers, ticks, titles and captions as a journal prints them."""

import math

import pytest
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.optics.fields import field_label
from dolens.plotting import (
    before_after_figure,
    history_figure,
)
from dolens.plotting.style import (
    TITLE,
    caption,
    draw_axes_title,
    draw_title,
    legend_below,
    line_styles,
    log_ticks,
    number_text,
    plain_text,
    value_and_error,
    wavelengths_text,
    with_minus,
)
from tests.plotting.overlaps import flaws


def test_the_checker_finds_what_it_is_for():
    figure = history_figure([3.0, 2.0, 1.0])
    assert not flaws(figure)
    axes = figure.axes[0]
    axes.text(1.0, 2.0, "over the line", ha="center")
    axes.text(1.0, 2.0, "over it", ha="center")
    axes.set_xlabel("-3")
    axes.set_ylabel("lengths")
    found = "\n".join(flaws(figure))
    for flaw in ("points of data", "covers 'over it'", "hyphen for a minus", "lengths"):
        assert flaw in found


@pytest.mark.parametrize(
    ("value", "sigma", "printed"),
    [
        (-666.725, 3.3, ("−667", "3")),
        (119.45, 0.0055, ("119.450", "0.005")),
        (1.64, 0.16, ("1.64", "0.16")),
        (123456.0, 1200.0, ("123500", "1200")),
        (5.0, 0.99, ("5", "1")),
        (-0.001, 0.3, ("0.0", "0.3")),
    ],
)
def test_a_value_has_the_digits_that_its_deviation_allows(value, sigma, printed):
    assert value_and_error(value, sigma) == printed


@pytest.mark.parametrize(
    ("value", "printed"),
    [(4e6, "4×10⁶"), (1e-7, "10⁻⁷"), (-4.5, "−4.5"), (96.44, "96.4"), (1200.0, "1200"), (0.0, "0")],
)
def test_powers_of_ten_are_written_as_such(value, printed):
    assert number_text(value) == printed


def test_only_a_hyphen_before_a_number_is_a_minus():
    assert with_minus("(-2, 0)° of U-Net, 3-4") == "(−2, 0)° of U-Net, 3-4"
    assert field_label((-2.0, 0.0), "°") == "(−2, 0)°"


def test_a_field_on_the_y_axis_is_one_number():
    labels = [field_label(point, "mm") for point in ((0.0, -14.0), (3.0, 14.0), (-0.0, -0.0))]
    assert labels == ["−14 mm", "(3, 14) mm", "0 mm"]


def test_no_two_lines_look_alike():
    looks = {(look["color"], str(look["linestyle"])) for look in line_styles(28)}
    assert len(looks) == 28


def ticks(low, high, most=8):
    axes = Figure().add_subplot()
    axes.set(xscale="log", xlim=(low, high))
    log_ticks(axes.xaxis, most)
    places = [float(place) for place in axes.xaxis.get_majorticklocs()]
    texts = axes.xaxis.get_major_formatter().format_ticks(places)
    return [(p, t) for p, t in zip(places, texts, strict=True) if low <= p <= high]


@pytest.mark.parametrize(
    ("low", "high", "places"),
    [
        (0.9, 110.0, [1, 2, 5, 10, 20, 50, 100]),
        (1.0, 12.0, [1, 1.5, 2.5, 4, 6, 10]),
        (31.15, 31.95, [31.2, 31.3, 31.4, 31.5, 31.6, 31.7, 31.8, 31.9]),
    ],
)
def test_an_axis_of_few_decades_has_round_numbers(low, high, places):
    assert [place for place, _ in ticks(low, high)] == pytest.approx(places, rel=1e-12)


@pytest.mark.parametrize("decades", [3.0, 9.0, 20.0])
def test_an_axis_of_many_decades_has_whole_powers_of_ten(decades):
    places = [place for place, _ in ticks(1e-5, 1e-5 * 10.0**decades)]
    assert 2 <= len(places) <= 9
    assert all(math.log10(p) == pytest.approx(round(math.log10(p)), abs=1e-9) for p in places)


def test_numbers_are_plain_where_they_are_short():
    assert [text for _, text in ticks(0.9, 9000.0)] == ["1", "10", "100", "1000"]


LONG = "Tilted singlet with a freeform corrector: f = 49.83 mm, F/4.98 at 587.6 nm\nmean RMS"


@pytest.mark.parametrize("width", [2.2, 3.0, 4.6])
def test_a_title_that_is_too_wide_is_broken_and_the_figure_grows_with_it(width):
    figure = Figure(figsize=(width, 3.0), layout="constrained")
    draw_title(figure, LONG)
    assert not any("cut" in flaw for flaw in flaws(figure))
    lines = figure.get_suptitle().split("\n")
    # Every word is there, in its order, and the line that was given stays its own.
    assert " ".join(lines).split() == LONG.split() and lines[-1] == "mean RMS"
    added = len(lines) - 2
    assert added and figure.get_figheight() == pytest.approx(3.0 + added * 1.3 * TITLE / 72.0)


def test_a_title_breaks_behind_a_colon_and_keeps_numbers_with_their_units():
    figure = Figure(figsize=(4.6, 3.0))
    draw_title(figure, LONG)
    assert figure.get_suptitle().split("\n")[:2] == [
        "Tilted singlet with a freeform corrector:",
        "f = 49.83 mm, F/4.98 at 587.6 nm",
    ]


def test_a_title_that_fits_stays_as_it_is():
    figure = Figure(figsize=(9.0, 3.0))
    draw_title(figure, LONG)
    draw_axes_title(figure.add_subplot(), LONG)
    assert figure.get_suptitle() == figure.axes[0].get_title() == LONG
    assert figure.get_figheight() == 3.0
    draw_title(Figure(), None)


def test_titles_of_axes_with_a_long_name_fit_too(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    lens.name = "A triplet whose name is as long as a catalogue has"
    assert not flaws(before_after_figure(lens, lens, rays=3))
    assert not flaws(history_figure([3.0, 2.0, 1.0], title=f"{lens.name}: history of the design"))


def test_a_legend_has_fewer_columns_where_the_figure_is_narrow():
    handles = [Line2D([], [], label=f"{wave} nm") for wave in range(400, 405)]
    for width, columns in ((7.2, 5), (3.0, 3)):
        figure = Figure(figsize=(width, 2.0), layout="constrained")
        legend = legend_below(figure, handles, 5)
        assert legend._ncols == columns
        assert [text.get_text() for text in legend.get_texts()] == [h.get_label() for h in handles]
        assert not flaws(figure)


LINES = (656.2725, 587.5618, 486.1327)


def test_captions_name_lens_aperture_and_light(triplet):
    far = conditions(triplet, wavelengths=LINES)
    assert caption("Fans", triplet, far) == "Fans: Cooke triplet, F/4.93, 486.1, 587.6, 656.3 nm"
    long = caption("Point spread functions", triplet, far)
    assert long == "Point spread functions: Cooke triplet,\nF/4.93, 486.1, 587.6, 656.3 nm"
    near = conditions(triplet, object_distance=500.0)
    assert "working F/" in caption("Fans", triplet, near)
    assert wavelengths_text([587.5618]) == "587.6 nm"
    assert wavelengths_text(range(400, 800, 100)) == "4 wavelengths from 400 to 700 nm"
    assert plain_text("a\nb $c$") == r"a b \$c\$"
    assert len(plain_text("x" * 100)) == 50
