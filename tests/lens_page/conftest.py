import copy
import re
from html.parser import HTMLParser

import pytest

from dolens.lens_page.overview import prepared_lens
from dolens.lens_page.page import write_page
from dolens.prescriptions import lens_from_prescription
from tests.prescriptions.samples import SINGLET

VOID = {"meta", "input", "br", "img", "link", "hr"}
HOSTILE = "<script>alert('é & \"ö\"')</script>"


class Page(HTMLParser):
    """A page's elements; each that opens must close, in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.links, self.titles, self.named = [], [], [], [], {}
        self.tables, self.text = [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.named.setdefault(tag, []).append(values)
        if "id" in values:
            self.ids.append(values["id"])
        self.links += [values[key] for key in ("href", "src") if key in values]
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.titles.append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data
        if self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)


@pytest.fixture(scope="session")
def hostile_lens():
    data = copy.deepcopy(SINGLET)
    data["name"] = HOSTILE
    data["elements"] = {HOSTILE.replace(".", ""): {"surfaces": [2, 3], "tilt_x": 0.01}}
    data["wavelengths"] = [587.5618]
    # No ray of the last field passes.
    data["fields"] = {"angles": [[0, 0], [0, 3], [0, 40]]}
    # A hole in front: the two faces of the glass follow, the first of them the stop.
    hole = {"type": "aperture", "semi_diameter": 5, "thickness": 20.0, "material": "air"}
    data["surfaces"] = {"1": hole, "2": data["surfaces"]["1"], "3": data["surfaces"]["2"]}
    data["stop"] = 2
    data["sensor"] = {"distance": 25.9, "diameter": 6.0}
    return lens_from_prescription(data)


@pytest.fixture(scope="session")
def page(hostile_lens, tmp_path_factory):
    """The page of a lens whose name is a program, and one of whose fields is dark."""
    folder = tmp_path_factory.mktemp("page")
    path = folder / "page.html"
    written = write_page(
        prepared_lens(hostile_lens, f_number=4.0),
        path,
        tolerances="default",
        figures=folder / "figures",
        command="dolens show '</code><script>'",
    )
    return path, written


@pytest.fixture(scope="session")
def parsed(page):
    return Page(page[0].read_text(encoding="utf-8"))


def number_in(text):
    """A number as a page writes it."""
    return float(re.sub("−", "-", text))
