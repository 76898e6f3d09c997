"""The page in the terminal gives the numbers that are known of a lens."""

import math
import re

import pytest
from typer.testing import CliRunner

from dolens import InputError, load_lens
from dolens.cli.app import app
from dolens.lens_page.overview import states_table


def show(*arguments):
    return CliRunner().invoke(app, ["show", *map(str, arguments)], env={"COLUMNS": "110"})


def test_the_triplet_as_published(root, reference):
    found = show(root / "conf/lens/cooke_triplet.yaml", "--wavelength", 587.5618)
    assert found.exit_code == 0, found.output
    text = found.output
    exact = reference("first_order.json")["data"]["triplet"]["dfc"]["587.5618"]
    for name, key in (("effective focal length", "efl"), ("back focal distance", "bfd")):
        value = float(re.search(rf"{name} +(\S+)", text)[1])
        assert math.isclose(value, float(exact[key]), rel_tol=1e-5)
    # The supplement calls it F/4.9.
    assert round(float(re.search(r"F-number +(\S+)", text)[1]), 1) == 4.9
    for words in ("Cooke triplet", "sphere (stop)", "1.6204/60.31", "Seidel sums", "20°"):
        assert words in text


def test_published_numbers_stand_beside_computed_ones():
    found = show("published/tessar_us2838978")
    assert found.exit_code == 0, found.output
    text = " ".join(found.output.split())
    assert re.search(r"effective focal length +1 ± 0\.01 +1\.000998", text)
    assert re.search(r"F-number +2\.8 +2\.8", text)
    assert "US 2,838,978" in text


def test_states_are_listed_and_shown():
    """US 9,784,950 B2 prints EFL 15.5 to 44.04 mm for its three positions."""
    found = show("published/zoom_us9784950_ex1", "--state", "f44")
    assert found.exit_code == 0, found.output
    assert "f = 44.043 mm" in found.output and "Zoom 15.5-44.0 mm f/2.9, f44" in found.output
    assert "Published numbers" in found.output and "44.04" in found.output
    table = states_table(load_lens("published/zoom_us9784950_ex1"))
    rows = {row[0]: row[1:] for row in table.rows}
    assert table.heads == ("state", "f15", "f21", "f44")
    assert rows["published"] == ("15.5", "21.49", "44.04")
    assert rows["thicknesses.5"] == ("1.65", "9.04", "18.89")


def test_long_lists_of_coefficients_stay_within_the_terminal():
    """An odd asphere of eight coefficients is a list that goes on in further lines."""
    found = show("published/mobile_us7535658_odd")
    assert max(map(len, found.output.splitlines())) <= 110
    assert "a4=0.02426, a6=0.0008371" in found.output
    assert "A semi-diameter in brackets clips nothing." in " ".join(found.output.split())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--state", "wide"], "has no state 'wide' (allowed: none, as the lens has no states)"),
        (["--field", "1,2,3"], "--field: must be a number (y) or two (x,y), not '1,2,3'"),
        (["--field", "95"], "fields must be within ±90 degrees"),
        (["--tolerances", "default"], "--tolerances needs --html or --figures"),
        (["--html", "page.pdf"], "--html: a page's file ends in .html, not 'page.pdf'"),
        (["--html", "nowhere/page.html"], "--html: there is no folder 'nowhere'"),
        (["--index-model", "mine"], "index_model: 'mine' is unknown"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_options_that_make_no_sense_take_one_line(arguments, said, root):
    found = show(root / "conf/lens/lb1757.yaml", *arguments)
    assert isinstance(found.exception, InputError)
    assert said in str(found.exception)
    assert "\n" not in str(found.exception)


def test_a_file_that_is_no_page_is_not_overwritten(root, tmp_path):
    mine = tmp_path / "mine.html"
    mine.write_text("mine")
    found = show(root / "conf/lens/lb1757.yaml", "--html", mine)
    assert "is no page of dolens; --force overwrites it" in str(found.exception)
    assert mine.read_text() == "mine"
