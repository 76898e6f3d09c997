"""Run folders become a table: what is the same but for the seed, what tells rows apart, gains."""

import csv
import io
import json

import pytest
import torch
import yaml
from omegaconf import OmegaConf
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.cli.compare import fitting
from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import TABLE, scores_by_photograph
from dolens.experiments.comparison.comparison import compared, csv_of, gain, markdown_of, plain
from dolens.experiments.comparison.rows import metric_label, setting_label
from dolens.experiments.comparison.sweep import SweepComparison, best_lines
from dolens.experiments.tables import write_table


def made(folder, experiment, seed, psnr, choices=None, views=("axis",), overrides=(), **config):
    """A run folder; `psnr` is one number, scores (photographs, views), or None: no results."""
    (folder / ".hydra").mkdir(parents=True)
    chosen = {"experiment": experiment, "hydra/launcher": "basic", **(choices or {})}
    hydra = {"runtime": {"choices": chosen}, "overrides": {"task": list(overrides)}}
    (folder / ".hydra/hydra.yaml").write_text(yaml.safe_dump({"hydra": hydra}))
    config = {"seed": seed, "train": True, "data": {"seed": "${seed}"}, **config}
    config.setdefault("objective", "test/psnr_db/worst")
    (folder / ".hydra/config.yaml").write_text(yaml.safe_dump(config))
    if psnr is None:
        return folder
    if isinstance(psnr, torch.Tensor):
        names = [f"photograph {number}" for number in range(len(psnr))]
        write_table(folder / TABLE, scores_by_photograph({"psnr_db": psnr}, names, views).rows())
        means = psnr.mean(dim=0).tolist()
    else:
        means = [psnr] * len(views)
    metrics = {f"test/psnr_db/{view}": mean for view, mean in zip(views, means, strict=True)}
    metrics["test/psnr_db/worst"] = min(means)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def settings(comparison):
    """The settings of each row by short names."""
    names = comparison.rows.columns
    return [{names[n]: v for n, v in row.settings.items()} for row in comparison.rows.rows]


def means(comparison, metric="test/psnr_db/worst"):
    return [row["values"][metric]["mean"] for row in plain(comparison)["rows"]]


def test_means_and_spreads_over_seeds(tmp_path):
    made(tmp_path / "a", "joint", 0, 26.0, threads=1)
    made(tmp_path / "b", "joint", 1, 28.0, threads=2)
    found = compared([tmp_path])
    assert found.heading() == ["row", "seeds", "test/psnr_db/worst"]
    assert [found.cells(row) for row in found.rows.rows] == [["1", "2", "27.00 ± 1.00"]]


def test_runs_of_other_networks_with_the_same_seed_are_other_rows(tmp_path):
    wiener, unet = {"network": "wiener_unet"}, {"network": "unet"}
    made(tmp_path / "a", "joint", 0, 26.0, wiener, network={"width": 32, "depth": 3})
    made(tmp_path / "b", "joint", 0, 24.0, unet, network={"channels": 8})
    made(tmp_path / "c", "joint", 0, 20.0, unet, network={"channels": 16})
    made(tmp_path / "d", "alone", 0, 23.0, unet, network={"channels": 8})
    found = compared([tmp_path])
    assert means(found) == [26.0, 24.0, 20.0, 23.0]
    assert settings(found) == [
        {"experiment": "joint", "network": "wiener_unet"},
        {"experiment": "joint", "network": "unet", "channels": 8},
        {"experiment": "joint", "network": "unet", "channels": 16},
        {"experiment": "alone", "network": "unet", "channels": 8},
    ]


def test_columns_are_the_settings_that_differ_with_their_values_filled_in(tmp_path):
    given = {"data": {"batch_size": 2, "root": "x"}}
    made(tmp_path / "a", "joint", 0, 26.0, **given, light=100, readout={"light": "${light}"})
    made(tmp_path / "b", "joint", 0, 26.0, **given, light=300, readout={"light": "${light}"})
    made(tmp_path / "c", "joint", 0, 26.0, **given, light=100, readout={"light": 50})
    found = compared([tmp_path])
    assert settings(found) == [
        {"light": 100, "readout.light": 100},
        {"light": 300, "readout.light": 300},
        {"light": 100, "readout.light": 50},
    ]


def test_a_short_name_says_which_surface(tmp_path):
    for name, radius in (("a", 20.0), ("b", 21.0)):
        lens = {"surfaces": {"1": {"radius": radius}, "2": {"radius": 5.0}}}
        made(tmp_path / name, "asphere", 0, 1.0, lens=lens)
    assert list(compared([tmp_path]).rows.columns.values()) == ["surfaces.1.radius"]


def test_what_follows_from_an_experiment_is_no_column_but_what_was_typed_is(tmp_path):
    typed = ["experiment=b", "loss.weight=2"]
    made(tmp_path / "a", "a", 0, 1.0, {"scene": "far"}, loss={"weight": 1}, depth=1)
    made(tmp_path / "b", "b", 0, 2.0, {"scene": "near"}, overrides=typed, loss={"weight": 2})
    assert list(compared([tmp_path]).rows.columns) == ["experiment", "loss.weight"]


def test_a_network_that_was_typed_is_one_column_and_not_all_of_its_keys(tmp_path):
    for name, keys in (("unet", {"depth": 3}), ("wiener", {"margin": 32, "depth": 2})):
        typed = [f"network={name}"]
        made(tmp_path / name, "a", 0, 1.0, {"network": name}, overrides=typed, network=keys)
    assert list(compared([tmp_path]).rows.columns) == ["network"]


def test_untrained_runs_of_other_checkpoints_are_not_seeds_of_one(tmp_path):
    made(tmp_path / "a", "joint", 0, 26.0, ckpt_path="one.ckpt", train=False)
    made(tmp_path / "b", "joint", 1, 26.0, ckpt_path="two.ckpt", train=False)
    assert len(compared([tmp_path]).rows.rows) == 2


def test_a_resumed_run_is_a_seed_like_others_and_a_run_from_elsewhere_is_not(tmp_path):
    made(tmp_path / "first", "joint", 0, None)
    made(tmp_path / "other", "joint", 0, None, light=3)
    resumed = str(tmp_path / "first/checkpoints/last.ckpt")
    made(tmp_path / "a", "joint", 0, 26.0, ckpt_path=resumed)
    made(tmp_path / "b", "joint", 1, 28.0)
    tuned = str(tmp_path / "other/checkpoints/last.ckpt")
    made(tmp_path / "c", "joint", 2, 30.0, ckpt_path=tuned)
    found = compared([tmp_path])
    assert means(found) == [27.0, 30.0]
    assert settings(found)[1] == {"ckpt_path": tuned}


def test_runs_that_differ_in_many_settings_stay_apart(tmp_path):
    for n in (1, 2):
        made(tmp_path / str(n), "joint", 0, 20.0 + n, **{f"key{k}": 1 for k in range(7)}, z=n)
    made(tmp_path / "3", "joint", 0, 26.0)
    found = compared([tmp_path])
    assert means(found) == [21.0, 22.0, 26.0]
    assert len({json.dumps(row) for row in settings(found)}) == 3


def test_the_same_run_twice_is_named_and_counts_once(tmp_path):
    for name, psnr in (("a", 25.0), ("b", 27.0)):
        made(tmp_path / name, "joint", 0, psnr)
    found = compared([tmp_path])
    assert means(found) == [27.0]
    (note,) = found.notes()
    assert "a and " in note and "have the same settings and seed 0; only " in note


def test_runs_of_several_versions_of_the_code_are_named(tmp_path):
    for seed in (0, 1):
        folder = made(tmp_path / str(seed), "joint", seed, 26.0)
        (folder / "run.json").write_text(json.dumps({"git": {"commit": f"{seed}" * 9}}))
    (note,) = compared([tmp_path]).notes()
    assert "00000000" in note and "11111111" in note


def test_runs_without_results_are_named_with_the_reason(tmp_path):
    made(tmp_path / "0", "joint", 0, 26.0)
    crashed = made(tmp_path / "1", "joint", 1, None)
    (crashed / "run.json").write_text('{"status": "failed"}')
    (crashed / "log.txt").write_text(
        "[2026-11-23 04:00:00,000] INFO dolens: began\n"
        "[2026-11-23 04:00:01,000] ERROR dolens.main: ValueError: no light\nTraceback ...\n"
    )
    killed = made(tmp_path / "2", "joint", 2, None)
    (killed / "run.json").write_text('{"status": "running"}')
    stopped = made(tmp_path / "10", "joint", 3, None)
    (stopped / "run.json").write_text('{"status": "interrupted"}')
    empty = tmp_path / "empty"
    empty.mkdir()
    notes = compared([tmp_path, empty, tmp_path / "nowhere"]).notes()
    assert [note.removeprefix(str(tmp_path)) for note in notes] == [
        "/1: failed: ValueError: no light",
        "/2: unfinished: it is still running, or was killed",
        "/10: interrupted: by Ctrl-C or a signal",
        "/empty is no run folder, and holds none (no .hydra/config.yaml)",
        "/nowhere does not exist",
    ]


def test_without_any_finished_run_the_reasons_are_the_error(tmp_path):
    made(tmp_path / "0", "joint", 0, None)
    with pytest.raises(InputError, match=r"no finished run: .*/0: failed: its log says no error"):
        compared([tmp_path])


def test_a_sweep_over_experiments_is_found_by_its_own_folder(tmp_path):
    sweep = tmp_path / "several/sweeps/today"
    sweep.mkdir(parents=True)
    (sweep / "multirun.yaml").touch()
    for job, name in enumerate(("a", "b")):
        made(tmp_path / name / "sweeps/today" / str(job), name, 0, 20.0 + job)
    assert means(compared([sweep])) == [20.0, 21.0]


def test_metrics_are_chosen_by_name_pattern_or_what_the_test_measured(tmp_path):
    made(tmp_path / "a", "joint", 0, 26.0, views=("8m", "6m"))
    views = ("test/psnr_db/6m", "test/psnr_db/8m", "test/psnr_db/worst")
    assert compared([tmp_path], ["psnr_db"]).metrics == views
    assert compared([tmp_path], ["*/6m", "test/psnr_db/8m"]).metrics == views[:2]
    with pytest.raises(InputError, match="no run has 'test/psnr/worst'; did you mean 'test/psnr_"):
        compared([tmp_path], ["test/psnr/worst"])


def test_a_single_run_shows_its_interval_over_photographs(tmp_path):
    folder = made(tmp_path / "a", "joint", 0, 26.0)
    metrics = json.loads((folder / "metrics.json").read_text())
    ends = {f"error/test/psnr_db/worst/{end}": v for end, v in (("low", 25.0), ("high", 27.5))}
    (folder / "metrics.json").write_text(json.dumps(metrics | ends))
    assert "| 1 | 1 | 26.00 [25.00, 27.50] |" in markdown_of(compared([tmp_path]))


def test_gains_are_paired_over_seeds_and_photographs(tmp_path):
    # Photographs differ by 30 dB and seeds by 2 dB, the gain by nothing.
    generator = torch.Generator().manual_seed(0)
    photographs = 30.0 * torch.rand(20, 1, generator=generator)
    for seed in range(3):
        base = photographs + 2.0 * seed + torch.tensor([0.0, 1.0])
        views = {"views": ("near", "far")}
        made(tmp_path / f"a{seed}", "joint", seed, base + 0.5, **views)
        made(tmp_path / f"b{seed}", "alone", seed, base, **views)
    found = compared([tmp_path], ["psnr_db"], against="alone")
    text = markdown_of(found)
    for metric in ("test/psnr_db/near", "test/psnr_db/far", "test/psnr_db/worst"):
        assert f"| 1 | {metric} | +0.500 [+0.500, +0.500] | 3 | 20 |" in text
    gains = plain(found)["rows"][0]["gains"]
    assert gains["test/psnr_db/worst"]["low"] == pytest.approx(0.5, abs=1e-5)
    assert gains["test/psnr_db/far"]["photographs"] == 20


def test_a_gain_that_photographs_do_not_share_has_a_wide_interval(tmp_path):
    gains = torch.tensor([1.0, -1.0] * 10)[:, None] + 0.1
    made(tmp_path / "a", "joint", 0, 25.0 + gains)
    made(tmp_path / "b", "alone", 0, torch.full((20, 1), 25.0))
    joint, alone = compared([tmp_path]).rows.rows
    found = gain(joint.runs, alone.runs, "psnr_db", "axis")
    # s/√n = 0.23 and t = 2.09.
    assert found.estimate == pytest.approx(0.1, abs=1e-5)
    assert found.low == pytest.approx(0.1 - 0.48, abs=0.05)
    assert found.high == pytest.approx(0.1 + 0.48, abs=0.05)


def test_runs_on_other_photographs_have_no_interval(tmp_path):
    made(tmp_path / "a", "joint", 0, torch.full((3, 1), 26.0))
    made(tmp_path / "b", "alone", 0, torch.full((4, 1), 25.0))
    made(tmp_path / "c", "old", 1, 24.0)
    text = markdown_of(compared([tmp_path], against="alone"))
    assert "| 1 | test/psnr_db/worst | +1.000 | 1 | not paired |" in text
    assert "| 3 | test/psnr_db/worst | no seed in common | 0 | – |" in text


def test_what_to_compare_with_is_one_row(tmp_path):
    made(tmp_path / "a", "joint", 0, 26.0, data={"batch_size": 2})
    made(tmp_path / "b", "joint", 0, 27.0, data={"batch_size": 4})
    with pytest.raises(InputError, match="'other' is no row; rows are 1: batch_size=2; 2: "):
        compared([tmp_path], against="other")
    with pytest.raises(InputError, match="'joint' is several rows; choose one by number"):
        compared([tmp_path], against="joint")
    for wanted in ("1", "batch_size=2", "data.batch_size=2"):
        assert compared([tmp_path], against=wanted).against.number == 1


def swept(folder, seeds=(0, 1)):
    for job, radius in enumerate((20.8, 20.9, 21.0)):
        for seed in seeds:
            lens = {"surfaces": {"1": {"radius": radius}, "2": {"radius": 1.0}}}
            psnr = 25.0 + job - 0.7 * job * job + 0.2 * seed
            made(folder / f"{2 * job + seed}", "asphere", seed, psnr, lens=lens)
    return folder


def test_a_csv_has_a_line_for_each_row_with_full_names(tmp_path):
    rows = list(csv.DictReader(io.StringIO(csv_of(compared([swept(tmp_path)])))))
    assert [row["lens.surfaces.1.radius"] for row in rows] == ["20.8", "20.9", "21"]
    assert rows[0]["seeds"] == "0 1"
    assert float(rows[0]["test/psnr_db/worst"]) == pytest.approx(25.1)
    assert float(rows[0]["test/psnr_db/worst half range"]) == pytest.approx(0.1)


def test_the_command_shows_writes_and_prints(tmp_path):
    swept(tmp_path / "runs")
    written = [f"--{name}={tmp_path / f'out.{name}'}" for name in ("csv", "json", "markdown")]
    arguments = ["compare", str(tmp_path / "runs"), *written, f"--figure={tmp_path / 'out.png'}"]
    done = CliRunner().invoke(app, arguments, env={"COLUMNS": "100"})
    assert done.exit_code == 0, done.output
    assert "surfaces.1.radius" in done.output and "25.10 ± 0.10" in done.output
    assert (tmp_path / "out.png").stat().st_size > 5000
    assert len(json.loads((tmp_path / "out.json").read_text())["rows"]) == 3
    done = CliRunner().invoke(app, ["compare", str(tmp_path / "runs"), "--json", "-"])
    assert json.loads(done.stdout)["metrics"] == ["test/psnr_db/worst"]


def test_a_narrow_terminal_keeps_the_number_the_first_setting_and_the_objective():
    columns = [["row", "1"], ["radius", "21"], ["glass", "x" * 30], ["seeds", "1"]]
    columns += [["objective", "2.9"], ["cost", "1"]]
    assert fitting(columns, 2, 200) == [0, 1, 2, 3, 4, 5]
    assert fitting(columns, 2, 45) == [0, 1, 3, 4, 5]
    assert fitting(columns, 2, 10) == [0, 1, 3, 4]


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("test/psnr_db/worst", "test PSNR, worst (dB)"),
        ("rms_spot_um/final", "RMS spot, final (µm)"),
        ("cost/step_s", "cost, step (s)"),
        ("test/ssim", "test SSIM"),
    ],
)
def test_metrics_have_labels_with_units(name, label):
    assert metric_label(name) == label


def test_settings_have_labels_with_units():
    assert setting_label("lens.surfaces.1.radius") == "radius of surface 1 (mm)"
    assert setting_label("optimizer.lr") == "optimizer.lr"


def test_a_sweep_writes_its_comparison_and_names_a_job_that_failed(tmp_path):
    """The command ends with status 1 then, after all has been written."""
    swept(tmp_path)
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})
    SweepComparison().on_multirun_end(config)
    names = {f"comparison.{suffix}" for suffix in ("md", "csv", "png")}
    assert names <= {path.name for path in tmp_path.iterdir()}
    failed = made(tmp_path / "6", "asphere", 0, None)
    (failed / "log.txt").write_text("[now] ERROR dolens: surface 1: semi_diameter exceeds\n")
    with pytest.raises(SystemExit, match=r"1 of 7 jobs failed: 6 \(surface 1: semi_diameter"):
        SweepComparison().on_multirun_end(config)
    text = (tmp_path / "comparison.md").read_text()
    assert "6: failed: surface 1: semi_diameter exceeds" in text


def test_a_sweep_says_how_its_best_job_is_repeated(tmp_path, caplog, monkeypatch):
    """More is better or less, by the metric's name, or as the run chose its best checkpoint."""
    monkeypatch.setattr("sys.argv", ["dolens train", "-m", "hydra/launcher=joblib"])
    for number, psnr in enumerate((24.0, 26.0, 25.0)):
        folder = made(tmp_path / "psnr" / str(number), "joint", 0, psnr, number=number)
        overrides = ["experiment=joint", f"network.name='a b {number}'"]
        (folder / ".hydra/overrides.yaml").write_text(yaml.safe_dump(overrides))
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path / "psnr")}}})
    with caplog.at_level("INFO"):
        SweepComparison().on_multirun_end(config)
    repeat = """dolens train experiment=joint 'network.name='"'"'a b 1'"'"''"""
    line = f"The best test/psnr_db/worst, 26, has {tmp_path / 'psnr/1'}; to repeat it: {repeat}"
    assert line in caplog.text and line in (tmp_path / "psnr/comparison.md").read_text()

    def best(name, value, **settings):
        folder = made(tmp_path / name / str(value), "joint", 0, 20.0, objective=name, **settings)
        (folder / "metrics.json").write_text(json.dumps({name: value}))
        return best_lines(compared([tmp_path / name]).found.runs)

    best("rms_spot_um/final", 3.0)
    assert best("rms_spot_um/final", 4.0)[0].startswith("The best rms_spot_um/final, 3,")
    best("test/glow", 1.0)
    assert best("test/glow", 2.0) == [
        "Whether more of test/glow is better is not known: see the table for the best job"
    ]
    checkpoints = {"best": {"monitor": "val/shine", "mode": "max"}}
    best("test/shine", 1.0, callbacks=checkpoints)
    assert best("test/shine", 2.0, callbacks=checkpoints)[0].startswith("The best test/shine, 2,")
