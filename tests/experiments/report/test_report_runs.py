"""The report's runs: in processes of their own, kept when finished, one failure no end."""

import json
import sys

import pytest
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.experiments.report import runs, session
from dolens.experiments.report.checks import Check
from dolens.experiments.report.plan import Item, Plan, Section, System
from dolens.experiments.report.runs import is_current, last_words, run_system
from dolens.experiments.report.session import Choice, Pace, make_report
from tests.experiments.report.report_runs import PLAN, finished_run

WRITES = """
import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
(folder / "metrics.json").write_text(json.dumps({"number": 1.0}))
(folder / "run.json").write_text(json.dumps({"status": "finished", "module": "report_writes"}))
print("written")
"""
FAILS = "import sys; print('no lens of this name'); sys.exit(3)"
# Takes an interrupt even where pytest runs in the background of a shell, which ignores them.
SLEEPS = """
import pathlib, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
folder = pathlib.Path(sys.argv[1])
try:
    (folder / "started").touch()
    time.sleep(60)
except KeyboardInterrupt:
    (folder / "interrupted").touch()
    raise
"""


class Silent:
    """Tells no one how far the report is, and remembers it."""

    def __init__(self):
        self.said = []

    def taken(self, system, folder):
        self.said.append(("taken", system.name))

    def started(self, system, number, count):
        self.said.append(("started", system.name, number, count))

    def tick(self, elapsed, remaining):
        assert elapsed >= 0.0 and remaining >= 0.0

    def ended(self, system, finish):
        self.said.append(("ended", system.name, finish.status))


@pytest.fixture
def plan(tmp_path, monkeypatch):
    """A system that fails before one that works, and their checks."""
    for name, code in (("writes", WRITES), ("fails", FAILS), ("sleeps", SLEEPS)):
        (tmp_path / f"report_{name}.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    systems = tuple(
        System(name, name, 1.0, module=f"report_{name}") for name in ("fails", "writes")
    )
    item = Item("S1", "t", "p", runs=("fails", "writes"))
    checks = (
        Check("S1", "writes", "number", "one", "exact", "s", 1.0, 0.1),
        Check("S1", "fails", "number", "one", "exact", "s", 1.0, 0.1),
    )
    monkeypatch.setattr(session, "load_checks", lambda plan: checks)
    return Plan(systems, (), (Section("One", (item,)),))


def test_a_run_that_fails_is_named_and_the_others_go_on(plan, tmp_path):
    announcer = Silent()
    made = make_report(plan, tmp_path / "report", Choice(), announcer)
    assert announcer.said == [
        ("started", "fails", 1, 2),
        ("ended", "fails", 3),
        ("started", "writes", 2, 2),
        ("ended", "writes", 0),
    ]
    assert made.failed == ("fails",) and made.missing == ()
    assert "no lens of this name" in made.page.read_text(encoding="utf-8")
    again = Silent()
    make_report(plan, tmp_path / "report", Choice(only=("writes",)), again)
    assert again.said == [("taken", "writes")]
    record = json.loads((tmp_path / "report/runs/writes/report_run.json").read_text())
    assert record["status"] == 0 and record["wall_s"] > 0.0 and record["cpu_s"] > 0.0


def test_a_run_counts_as_finished_only_with_the_same_code_and_settings(plan, tmp_path):
    system, folder = plan.systems[1], tmp_path / "runs/writes"
    run_system(system, folder, lambda elapsed: None)
    assert is_current(system, folder)
    record = json.loads((folder / "report_run.json").read_text())
    (folder / "report_run.json").write_text(json.dumps({**record, "code": "another"}))
    assert not is_current(system, folder) and is_current(system, folder, any_code=True)
    assert not is_current(System("writes", "w", 1.0, ("experiment=nikon",)), folder, any_code=True)
    assert last_words(folder.with_name("writes.log")) == "written"


def test_an_interrupt_ends_the_run_and_writes_the_page(plan, tmp_path, monkeypatch):
    folder = tmp_path / "report/runs/writes"

    class Impatient(Silent):
        def tick(self, elapsed, remaining):
            if (folder / "started").exists():
                raise KeyboardInterrupt

    # No terminal interrupts the run beside the report here, so there is nothing to wait for.
    monkeypatch.setattr(runs, "_FIRST_GRACE_S", 0.0)
    sleeping = System("writes", "w", 1.0, module="report_sleeps")
    plan = Plan((sleeping,), (), ())
    with pytest.raises(KeyboardInterrupt):
        make_report(plan, tmp_path / "report", Choice(), Impatient())
    assert (tmp_path / "report/index.html").is_file()
    assert (folder / "interrupted").exists()
    assert not is_current(sleeping, folder, any_code=True)


def test_a_folder_of_someone_else_is_not_emptied(plan, tmp_path):
    finished_run(tmp_path / "mine")
    with pytest.raises(FileExistsError):
        run_system(plan.systems[1], tmp_path / "mine", lambda elapsed: None)
    assert (tmp_path / "mine/metrics.json").is_file()


def test_the_time_that_is_left_follows_the_pace_of_this_machine():
    pace = Pace()
    assert pace.remaining(10.0, 4.0, [20.0]) == 26.0
    pace.finished(10.0, 20.0)
    assert pace.remaining(10.0, 25.0, [20.0]) == 40.0


def test_the_command_fails_where_a_check_does(tmp_path, monkeypatch):
    """Status 1, or 0 with --no-fail; what does not hold is said."""
    run = finished_run(tmp_path / "asphere", metrics={"rms_spot_um/final": 5.0})
    options = ["report", "--no-run", "--folder", str(tmp_path / "r"), "--runs", f"asphere={run}"]
    failed = CliRunner().invoke(app, options)
    assert failed.exit_code == 1
    assert "does not hold: Table I (Section III A): RMS spot radius of our design" in failed.output
    assert CliRunner().invoke(app, [*options, "--no-fail"]).exit_code == 0
    page = (tmp_path / "r/index.html").read_text(encoding="utf-8")
    assert "do not hold" in page and sys.executable not in page


def test_the_command_lists_the_systems():
    listed = CliRunner().invoke(app, ["report", "--list"])
    assert listed.exit_code == 0 and "nikon_identity_damping" in listed.output
    assert PLAN.systems  # the small plan of these tests is another one
