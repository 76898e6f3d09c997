"""`dolens train -m search=optuna`: the trials of a search are the jobs of a sweep."""

import sys

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from optuna.trial import TrialState
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.errors import InputError
from dolens.experiments.search.pruning import PruneTrial, TrialPruned
from dolens.experiments.search.storage import record_of_job
from tests.experiments.runs import Finished
from tests.experiments.search.test_search import begun
from tests.experiments.tiny_experiment import QUIET, UNPICTURED

SHORT = [
    *("experiment=asphere", "optimizer=adam", "optimizer.betas=[0.5,0.9]", "backend=reference"),
    *("data.iterations=3", "trainer.max_epochs=2", "module.round_tolerance=0"),
    *("merit.sampling_options.count=7", UNPICTURED, "callbacks.files=null"),
    *("callbacks.progress=null", QUIET, "logger.tensorboard=null"),
]


@pytest.fixture
def called(tmp_path, monkeypatch):
    """Call `dolens train` in a folder of its own; return its exit status and what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "argv", [])

    def call(*arguments):
        done = CliRunner().invoke(app, ["train", *arguments], env={"COLUMNS": "100"})
        return done.exit_code, done.output

    yield call
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None


def test_a_search_prunes_what_falls_behind_and_leaves_tables_and_the_best_command(called, tmp_path):
    status, _ = called(
        *("-m", *SHORT, "search=optuna", "hydra/sweeper/pruner=median", "hydra.sweep.dir=found"),
        *("optimizer.lr=choice(0.003,1e-6)", "hydra.sweeper.trials=5"),
        *("hydra.sweeper.pruner.n_startup_trials=1", "hydra.sweeper.pruner.n_warmup_steps=0"),
    )
    assert status == 0
    found = tmp_path / "found"
    runs = {n: Finished(found / str(n)).info["status"] for n in range(5)}
    pruned = [n for n, status in runs.items() if status == "pruned"]
    assert 0 < len(pruned) < 5
    assert set(runs.values()) == {"pruned", "finished"}
    assert not any((found / str(n) / "metrics.json").exists() for n in pruned)
    for name in ("comparison.md", "search.md"):
        text = (found / name).read_text()
        assert "val/merit = " in text and "after epoch" in text and f"{len(pruned)} " in text
    (command,) = (line for line in text.splitlines() if line.startswith("dolens train"))
    assert "optimizer.lr=0.003" in command and "-m" not in command
    for name in ("multirun.yaml", "search.journal", "search.png", "comparison.png"):
        assert (found / name).is_file()


SEARCH = ["-m", *SHORT, "search=optuna"]
MEDIAN = "hydra/sweeper/pruner=median"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (SEARCH, "there is nothing to search; give a value as interval(low,high)"),
        ([*SEARCH, "optimizer.lrr=interval(1,2)"], "optimizer.lrr: there is no such setting"),
        ([*SEARCH, "seed=1,2", "hydra/sweeper/sampler=tpa"], "did you mean 'tpe'?"),
        (
            ["-m", "search=optuna", "experiment=asphere,pose_bounds"],
            "a search has one objective for all",
        ),
        (
            [*SEARCH, "seed=1,2", "objective=[test/ssim,cost/wall_s]", MEDIAN],
            "hopeless by 2 objectives",
        ),
    ],
)
def test_a_mistake_is_one_line_before_any_job(called, tmp_path, arguments, expected):
    status, output = called(*arguments, "hydra.sweep.dir=found")
    assert status == 1
    (line,) = (line for line in output.splitlines() if line.startswith("error: "))
    assert expected in line
    assert not (tmp_path / "found" / "0").exists()


@pytest.fixture
def as_trial(trained, tmp_path, monkeypatch):
    """Run the first trial of a search that prunes; return the search."""

    def build(direction="minimize", **others):
        found = begun(tmp_path / "search", directions=(direction,), pruner=NEVER, **others)
        (trial,) = found._propose()
        journal = tmp_path / "search" / "search.journal"
        callback = PruneTrial(journal, trial.number, found.settings)
        monkeypatch.setattr(
            "dolens.experiments.running.training.trial_callbacks", lambda: [callback]
        )
        trained(*SHORT)
        return found

    return build


NEVER = {"_target_": "optuna.pruners.NopPruner"}


@pytest.mark.parametrize("direction", ["minimize", "maximize"])
def test_a_search_is_told_so_that_a_pruner_compares_as_the_study_does(as_trial, direction):
    search = as_trial(direction=direction, every_n_steps=2, monitor="train/merit")
    (told,) = (trial.intermediate_values for trial in search.record.study.trials)
    assert list(told) == [2, 4, 6]
    values = [value if direction == "minimize" else -value for value in told.values()]
    assert 0.0 < values[-1] < values[0]


def test_a_metric_to_prune_by_that_is_never_logged_is_one_line(as_trial):
    with pytest.raises(InputError, match="'val/loss' was never logged"):
        as_trial(monitor="val/loss")


def test_a_run_that_its_search_has_repeated_stops(as_trial, tmp_path):
    def finish(self, trainer, pl_module):
        other = record_of_job(tmp_path / "search" / "search.journal")
        other.study.tell(0, state=TrialState.FAIL)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PruneTrial, "on_train_start", finish)
        with pytest.raises(TrialPruned, match="went on without it"):
            as_trial()
    assert Finished(tmp_path / "run").info["status"] == "pruned"


def test_a_run_returns_each_of_several_objectives(trained):
    values = trained(*SHORT, "objective=[rms_spot_um/final,cost/iterations]").objective
    assert values[0] > 0 and values[1] == 6


@pytest.mark.parametrize("objective", ["[]", "[a,a]", "[1]", "{a:1}"])
def test_an_objective_that_is_none_is_one_line(refused, objective):
    refused("objective: ", *SHORT, f"objective={objective}")
