"""The report's page: from finished runs to one HTML file."""

import html.parser
import json

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.report.checks import Material, State, outcomes
from dolens.experiments.report.page import (
    gain_sentence,
    number_text,
    page,
    prose,
    seconds_text,
    step_text,
    value_text,
)
from dolens.experiments.report.prescriptions import load_golden_rays, trace_errors
from dolens.experiments.report.runs import (
    assigned,
    code_fingerprint,
    gain_numbers,
    read_result,
    same_overrides,
)
from tests.experiments.report.report_runs import CHECKS, PLAN, finished_run


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return read_result("singlet", finished_run(tmp_path_factory.mktemp("runs") / "singlet"))


@pytest.fixture(scope="module")
def text(result):
    found = outcomes(CHECKS, {"singlet": result.metrics})
    failed = {"other": "error: <no lens>"}
    return page(Material(PLAN, {"singlet": result}, {}, found, failed, "Made now.", "c0de"))


def test_the_page_links_to_photographs_of_a_run(result):
    given = Material(PLAN, {"singlet": result}, {}, (), {}, "Made now.", "c0de")
    folder = result.folder.parents[1] / "a report"
    assert "photographs.html" not in page(given, folder)
    (result.folder / "photographs.html").write_text("")
    assert f'href="../{result.folder.parent.name}/singlet/photographs.html"' in page(given, folder)
    (result.folder / "photographs.html").unlink()


def test_checks_hold_fail_or_were_not_run(result):
    states = [outcome.state for outcome in outcomes(CHECKS, {"singlet": result.metrics})]
    assert states == [State.HOLDS, State.FAILS, State.FAILS, State.NOT_RUN]


def test_a_metric_that_is_missing_or_no_number_does_not_pass():
    renamed = outcomes(CHECKS[2:3], {"singlet": {"rms_spot_um/final": 2.9}})[0]
    assert renamed.state is State.FAILS and renamed.note == "the run has no such metric"
    assert not CHECKS[0].holds_for(float("nan"))


class Tags(html.parser.HTMLParser):
    """Collects what a page opens and does not close, and all that it refers to."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.ids = [], [], []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.addresses += [values[key] for key in ("src", "href") if key in values]
        self.ids += [values["id"]] if "id" in values else []
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_refers_to_nothing_outside(text):
    tags = Tags()
    tags.feed(text)
    assert not tags.open
    inside = {f"#{name}" for name in tags.ids}
    pictures = [address for address in tags.addresses if address.startswith("data:image/webp")]
    assert len(pictures) == 1
    assert set(tags.addresses) - set(pictures) <= inside


def test_text_is_escaped(text):
    assert "Two &lt;b&gt;prescriptions&lt;/b&gt;, see <code>conf/lens</code>." in text
    assert "A &lt;singlet&gt;" in text and "The &lt;lens&gt;." in text and "&lt;no lens&gt;" in text
    assert prose("a `b<` c") == "a <code>b&lt;</code> c"


@pytest.mark.parametrize(
    "words",
    [
        "1 holds",
        "2 do not hold",
        "1 was not run",
        "20.50",  # the radius of lens/final.yaml
        "2.895 ± 0.010 (95 %: 2.800 to 3.000)",
        "not run",
        "No picture yet of singlet: absent.",
        "1 min 15 s, 12\N{NARROW NO-BREAK SPACE}345 rays, 1.5 GB of memory",
        "dolens train experiment=nikon data.iterations=3",
        "another version (abcdef)",
        "The search goes on.",
        "python -m pytest tests/optics/test_surfaces.py",
    ],
)
def test_the_page_says(text, words):
    assert words in text


def test_numbers_are_written_for_readers():
    assert number_text(-0.00012345, 3) == "\N{MINUS SIGN}0.000123"
    assert number_text(1.8466e-8, 2) == "1.8·10⁻⁸"
    assert number_text(float("nan")) == "no number"
    assert value_text(1.5720432910, 1e-8) == "1.572043291"
    assert [seconds_text(s) for s in (0.25, 59.7, 7500.0)] == ["0.2 s", "1 min 0 s", "2 h 5 min"]
    assert [step_text(s) for s in (0.0047, 0.468, 1.52)] == ["4.7 ms", "468 ms", "1.5 s"]


def test_finished_runs_are_taken_by_their_overrides(tmp_path):
    run = finished_run(tmp_path / "a", ("threads=1", "experiment=asphere"))
    finished_run(tmp_path / "b", ("experiment=nikon", "data.iterations=4"))
    assert assigned(PLAN, [str(tmp_path)]) == {"singlet": run}
    assert assigned(PLAN, [str(run)]) == {"singlet": run}
    assert assigned(PLAN, [f"other={run}"]) == {"other": run}
    with pytest.raises(InputError, match="no system of the report has its overrides"):
        assigned(PLAN, [str(tmp_path / "b")])
    with pytest.raises(InputError, match="not the folder of a finished run"):
        assigned(PLAN, [f"other={tmp_path}"])
    finished_run(tmp_path / "stopped/a", status="interrupted")
    with pytest.raises(InputError, match="no finished run"):
        assigned(PLAN, [str(tmp_path / "stopped")])


def test_the_seed_counts_and_the_threads_do_not():
    assert same_overrides(["a=1", "threads=2", "hydra.run.dir=x"], ["a=1"])
    assert not same_overrides(["a=1", "seed=2"], ["a=1"])


def test_a_gain_is_paired_over_photographs(tmp_path):
    """One camera is better by exactly 1 dB on each photograph: the interval has no width."""
    results = []
    for name, gain in (("a", 1.0), ("b", 0.0)):
        folder = finished_run(tmp_path / name)
        lines = ["photograph,crops,view,psnr_db"]
        lines += [
            f"{photograph},1,{view},{level + gain}"
            for photograph, level in (("p", 20.0), ("q", 26.0), ("r", 23.0))
            for view, level in (("near", level), ("far", level - 2.0))
        ]
        (folder / "test_wave_photographs.csv").write_text("\n".join(lines))
        results.append(read_result(name, folder))
    numbers = gain_numbers(*results, "wave")
    for end in ("", "/low", "/high"):
        assert numbers[f"gain/psnr_db/worst{end}"] == pytest.approx(1.0)
        assert numbers[f"gain/psnr_db{end}"] == pytest.approx(1.0)
    assert numbers["gain/photographs"] == 3.0
    assert gain_numbers(*results) == {}  # the test's own renderer left no scores


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(0.1, 0.9, "a gain"), (-0.9, -0.1, "a loss"), (-0.1, 0.9, "does not show a gain")],
)
def test_a_gain_is_said_with_its_interval(low, high, verdict):
    key = "gain/psnr_db/worst"
    numbers = {key: 0.5, f"{key}/low": low, f"{key}/high": high, "gain/photographs": 3.0}
    assert verdict in gain_sentence(numbers) and "3 photographs" in gain_sentence(numbers)


def test_the_fingerprint_is_short_and_stable():
    first = code_fingerprint()
    code_fingerprint.cache_clear()
    assert code_fingerprint() == first and len(first) == 12


def test_the_golden_rays_are_met():
    """One bundle; the report traces them all."""
    bundles = [bundle for bundle in load_golden_rays() if bundle["name"] == "cooke_triplet_tilted"]
    assert trace_errors(bundles)["trace_error_nm/cooke_triplet_tilted"] < 1e-5
    assert torch.is_grad_enabled() and json.dumps(bundles[0]["elements"])
