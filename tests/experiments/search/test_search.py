"""A search proposes trials, takes what becomes of them, and goes on where it was stopped."""

import json
import math
import shutil

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import (
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from dolens.errors import InputError
from dolens.experiments.running.run_files import info_of, write_json
from dolens.experiments.search.search import INTERRUPTED, Result, Search, outcome, search_space
from dolens.experiments.search.settings import SearchSettings, direction_of, directions_of
from dolens.experiments.search.sweep import best_trials, markdown_of, write_report

TPE = {"_target_": "optuna.samplers.TPESampler", "n_startup_trials": 4}


def space(*texts):
    return search_space(OverridesParser.create().parse_overrides(list(texts)))


PLANE = space("experiment=asphere", "x=interval(-1,1)", "y=interval(-1,1)")


def bowl(overrides):
    """A smooth function of x and y; the least is 0 at (0.3, -0.2)."""
    values = dict(text.split("=") for text in overrides)
    return (float(values["x"]) - 0.3) ** 2 + (float(values["y"]) + 0.2) ** 2


def settings(trials=8, **others):
    return SearchSettings(**{"trials": trials, "batch": 1, "seed": 0, "sampler": TPE, **others})


def begun(folder, found=PLANE, objectives=("error/x",), directions=("minimize",), **others):
    folder.mkdir(exist_ok=True)
    return Search(folder, found, settings(**others), objectives, directions)


class Launcher:
    """Runs jobs at once; the command dies within the job `dies`."""

    def __init__(self, value=bowl, dies=None):
        self.value, self.dies, self.jobs = value, dies, {}

    def __call__(self, jobs, first):
        results = []
        for number, job in enumerate(jobs, first):
            if number == self.dies:
                raise KeyboardInterrupt
            self.jobs[number] = job
            value = self.value(job)
            results.append(Result(value if isinstance(value, tuple) else (value,)))
        return results


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a.b=interval(20,22)", FloatDistribution(20.0, 22.0)),
        ("a=int(interval(1,8))", IntDistribution(1, 8)),
        ("a=tag(log,interval(1e-5,1))", FloatDistribution(1e-5, 1.0, log=True)),
        ("a=range(1,8,3)", IntDistribution(1, 7, step=3)),
        ("a=shuffle(range(3,0,-1))", IntDistribution(1, 3)),
        ("a=range(0,1,step=0.5)", FloatDistribution(0.0, 0.5, step=0.5)),
        ("+a=8,16", CategoricalDistribution(("8", "16"))),
        ("a=choice('b c',{x:1},true)", CategoricalDistribution(("b\\ c", "{x:1}", "True"))),
    ],
)
def test_the_words_of_hydra_s_sweeps_are_what_is_searched(text, expected):
    found = space("seed=3", text)
    assert found.parameters == {text.partition("=")[0]: expected}
    assert found.fixed == ("seed=3",)


def test_a_job_has_what_is_fixed_and_its_own_values_and_hydra_can_read_them():
    found = space("a=interval(0,1)", "experiment=asphere", "b='x y',z", "a=interval(2,3)")
    job = found.overrides({"a": 2 + 1e-7 / 3, "b": "'x y'"})
    assert job == ["experiment=asphere", "b='x y'", "a=2.00000003333"]
    OverridesParser.create().parse_overrides(job)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a=3", "nothing to search"),
        ("a=interval(22,20)", "a=interval(22,20): the lower end comes first"),
        ("a=interval(1,1)", "the upper one is larger"),
        ("a=interval(0,inf)", "two finite ends"),
        ("a=tag(log,interval(0,1))", "positive"),
        ("a=tag(lgo,interval(1,2))", "'lgo' is unknown"),
        ("a=tag(log,range(1,4))", "tag is for interval"),
        ("a=range(5,5)", "nothing between start and stop"),
    ],
)
def test_what_cannot_be_searched_is_one_line(text, expected):
    with pytest.raises(InputError) as caught:
        space(text)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("metric", "expected"),
    [
        ("test/psnr_db/worst", "maximize"),
        ("test/ssim", "maximize"),
        ("alignment/named_right", "maximize"),
        ("error/test/psnr_db/low", "minimize"),
        ("rms_spot_um/final", "minimize"),
        ("tolerance/rms_um/p90", "minimize"),
        ("cost/step_s", "minimize"),
        ("pose_error/over_bound", "minimize"),
        ("val/merit", "minimize"),
        ("efl_mm/spread", None),
    ],
)
def test_a_metric_s_name_tells_whether_more_is_better(metric, expected):
    assert direction_of(metric) == expected


def test_a_direction_that_the_name_does_not_tell_is_asked_for():
    with pytest.raises(InputError, match=r"directions=\[maximize\] or \[minimize\]"):
        directions_of(["efl_mm/spread"], None)
    assert directions_of(["efl_mm/spread"], ["minimize"]) == ["minimize"]
    with pytest.raises(InputError, match="1 for 2 objectives"):
        directions_of(["a", "b"], ["minimize"])
    with pytest.raises(InputError, match="'min' is unknown"):
        directions_of(["a"], ["min"])


def test_the_same_search_makes_the_same_trials_and_another_seed_makes_others(tmp_path):
    jobs = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        launcher = Launcher()
        begun(tmp_path / name, seed=seed).run(launcher)
        jobs.append(launcher.jobs)
    assert len(jobs[0]) == 8 and jobs[0] == jobs[1] != jobs[2]
    assert len({tuple(job) for job in jobs[0].values()}) == 8


def test_a_search_that_was_stopped_goes_on_as_if_it_had_not_been(tmp_path):
    whole, first, second = Launcher(), Launcher(dies=5), Launcher()
    begun(tmp_path / "whole").run(whole)
    with pytest.raises(KeyboardInterrupt):
        begun(tmp_path / "a").run(first)
    write_json(tmp_path / "a" / "run.json", {})
    (tmp_path / "a" / "5").mkdir()
    search = begun(tmp_path / "a")
    search.run(second)
    # Trial 5 is repeated as 6, and all that follow have the next number.
    assert {n: job for n, job in whole.jobs.items() if n < 5} == first.jobs
    assert {n + 1: job for n, job in whole.jobs.items() if n >= 5} == second.jobs
    assert len(search.trials()) == 8
    assert info_of(tmp_path / "a" / "5")["status"] == "repeated"
    again = Launcher()
    begun(tmp_path / "a").run(again)
    assert not again.jobs
    begun(tmp_path / "a", trials=10).run(again)
    assert sorted(again.jobs) == [9, 10]


def test_a_job_that_ended_when_the_command_died_is_not_run_again(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        begun(tmp_path, trials=4, batch=2).run(Launcher(dies=3))
    (tmp_path / "2").mkdir()
    write_json(tmp_path / "2" / "metrics.json", {"error/x": -5.0})
    write_json(tmp_path / "2" / "run.json", {"status": "finished"})
    launcher = Launcher()
    search = begun(tmp_path, trials=4, batch=2)
    search.run(launcher)
    assert list(launcher.jobs) == [4]
    assert best_trials(search)[0].values == [-5.0]


def test_a_search_survives_a_kill_and_a_torn_journal(tmp_path):
    """Every entry is on the disk before the search goes on: a copy is what a kill leaves."""

    def killed(job):
        calls.append(job)
        if len(calls) == 4:
            shutil.copytree(tmp_path / "alive", tmp_path / "killed")
        return bowl(job)

    calls = []
    begun(tmp_path / "alive", trials=6, batch=3).run(Launcher(killed))
    journal = tmp_path / "killed" / "search.journal"
    with journal.open("a") as file:
        file.write('{"op_code":4,"worker')
    search = begun(tmp_path / "killed", trials=6, batch=3)
    launcher = Launcher()
    search.run(launcher)
    assert sorted(launcher.jobs) == [6, 7, 8]
    trials = search.record.study.get_trials()
    lost = [trial for trial in trials if INTERRUPTED in trial.user_attrs]
    assert [trial.number for trial in lost] == [3, 4, 5]
    assert [trial.params for trial in lost] == [trial.params for trial in trials[6:]]
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_trials_that_fail_do_not_end_a_search_and_are_not_proposed_for_ever(tmp_path):
    def half(job):
        return math.nan if "x=-" in job[1] else bowl(job)

    launcher = Launcher(half)
    search = begun(tmp_path, trials=20)
    search.run(launcher)
    outcomes = [outcome(trial) for trial in search.trials()]
    assert outcomes[:10].count("failed") > 1
    assert outcomes[10:].count("failed") < 4
    assert "failed" in markdown_of(search)


@pytest.mark.parametrize("batch", [1, 5])
def test_a_search_whose_first_trials_all_fail_ends_with_the_reason(tmp_path, batch):
    def launch(jobs, first):
        for number in range(first, first + len(jobs)):
            run = tmp_path / str(number)
            run.mkdir()
            (run / "log.txt").write_text("[now] ERROR dolens.x: nothing reads this setting\n")
            launched.append(number)
        return [Result((), tmp_path / str(first))] * len(jobs)

    launched = []
    with pytest.raises(InputError, match="trials all failed: nothing reads this setting"):
        begun(tmp_path, batch=batch).run(launch)
    assert len(launched) == max(3, batch)


NSGA2 = {"_target_": "optuna.samplers.NSGAIISampler", "population_size": 6}


@pytest.mark.parametrize("sampler", [NSGA2, TPE])
def test_two_objectives_have_a_front_and_a_command_for_each_of_its_trials(tmp_path, sampler):
    def costly(job):
        x, y = (float(text.partition("=")[2]) for text in job[1:])
        return (math.nan, 1.0) if y > 0.9 else (1.0 - x * x, 1.0 + x + y)

    search = begun(
        tmp_path,
        objectives=("test/psnr_db", "cost/step_s"),
        directions=("maximize", "minimize"),
        trials=12,
        sampler=sampler,
    )
    search.run(Launcher(costly))
    write_report(search)
    front = best_trials(search)
    finished = [trial.values for trial in search.trials() if outcome(trial) == "finished"]
    for trial in front:
        worth, cost = trial.values
        assert not any((w >= worth and c < cost) or (w > worth and c <= cost) for w, c in finished)
    text = (tmp_path / "search.md").read_text()
    assert text.count("experiment=asphere x=") == len(front) < len(finished)
    assert (tmp_path / "search.png").stat().st_size > 5000


def test_the_best_trials_come_first_and_the_parameter_that_matters_is_named(tmp_path):
    def ridge(job):
        return -((float(job[1].partition("=")[2]) - 0.3) ** 2)

    search = begun(tmp_path, trials=20, directions=("maximize",))
    search.run(Launcher(ridge))
    write_report(search)
    values = [trial.values[0] for trial in best_trials(search)]
    assert values == sorted(values, reverse=True) and values[0] > -0.02
    text = (tmp_path / "search.md").read_text()
    share = next(line for line in text.splitlines() if line.startswith("| error/x |"))
    x, y = (int(cell.strip().rstrip("%")) for cell in share.split("|")[2:4])
    assert x > y and x + y == pytest.approx(100, abs=1)


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ({"objectives": ("error/y",)}, "a search with other objectives: error/x, not error/y"),
        ({"found": space("x=interval(-1,2)", "experiment=asphere")}, "with other parameters"),
        ({"found": space("x=interval(-1,1)", "y=interval(-1,1)", "seed=1")}, "other overrides"),
        ({"directions": ("maximize",)}, "other directions: minimize, not maximize"),
        ({"pruner": {"n_startup_trials": 3}}, "choose by hydra/sweeper/pruner"),
        ({"pruner": {"_target_": "optuna.pruners.MedianPruner", "x": 1}}, "unknown key 'x'"),
        ({"sampler": {"_target_": "optuna.samplers.TPE"}}, "optuna.samplers.TPE"),
        ({"trials": 0}, "hydra.sweeper.trials: 0; allowed: integers from 1"),
        ({"batch": 1.5}, "hydra.sweeper.batch: 1.5"),
    ],
)
def test_other_settings_than_before_and_wrong_ones_are_one_line(tmp_path, others, expected):
    begun(tmp_path)
    with pytest.raises(InputError) as caught:
        begun(tmp_path, **others)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_a_journal_that_is_none_and_a_second_command_are_one_line(tmp_path):
    search = begun(tmp_path / "a")

    def second(jobs, first):
        begun(tmp_path / "a").run(Launcher())

    with pytest.raises(InputError, match="another command is searching there"):
        search.run(second)
    (tmp_path / "b").mkdir()
    for content in ("hello\n", "[1]\n", '{"op_code": 99}\n'):
        (tmp_path / "b" / "search.journal").write_text(content)
        with pytest.raises(InputError, match="is no record of a search"):
            begun(tmp_path / "b")


def test_settings_are_read_with_the_sweeper_s_own_beside_them():
    sweeper = {"_target_": "x", "params": {"a": "1,2"}, "storage": None, **vars(settings())}
    assert SearchSettings.of(sweeper) == settings()
    with pytest.raises(InputError, match="unknown key 'trial'; did you mean"):
        SearchSettings.of({**sweeper, "trial": 3})


def test_without_optuna_one_line_names_the_extra(monkeypatch):
    monkeypatch.setattr("dolens.experiments.search.settings.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'dolens\[search\]'"):
        settings()
