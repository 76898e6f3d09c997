"""Run folders become a table: means over seeds, spreads, and gains seed by seed."""

import json

import pytest
import yaml

from scripts.compare import main, read_run, table


def made(folder, experiment, seed, psnr, lens="adam"):
    (folder / ".hydra").mkdir(parents=True)
    choices = {"hydra": {"runtime": {"choices": {"experiment": experiment}}}}
    (folder / ".hydra/hydra.yaml").write_text(yaml.safe_dump(choices))
    config = {"seed": seed, "optimizer": {"lens": lens}, "variables": {"thicknesses.1": None}}
    (folder / ".hydra/config.yaml").write_text(yaml.safe_dump(config))
    (folder / "metrics.json").write_text(json.dumps({"test/psnr_db/axis": psnr}))
    return folder


def test_means_spreads_and_gains(tmp_path):
    folders = [
        made(tmp_path / "a", "joint", 0, 26.0),
        made(tmp_path / "b", "joint", 1, 28.0),
        made(tmp_path / "c", "alone", 0, 25.0),
        made(tmp_path / "d", "alone", 1, 26.0),
        made(tmp_path / "e", "joint", 0, 27.0, "dls"),
    ]
    runs = {}
    for folder in folders:
        name, seed, metrics = read_run(folder)
        runs.setdefault(name, {})[seed] = metrics
    lines = table(runs, "psnr_db", "alone")
    assert "| joint | 2 | 27.00 ± 1.00 |" in lines
    # Seed by seed: 1 and 2.
    assert "| joint - alone | 2 | +1.50 ± 0.50 |" in lines
    assert "| joint, dls - alone | 1 | +2.00 ± 0.00 |" in lines


def test_an_unknown_experiment_to_compare_with_is_an_error(tmp_path, capsys):
    folder = made(tmp_path / "a", "joint", 0, 26.0)
    with pytest.raises(SystemExit):
        main([str(folder), "--against", "other"])
    assert "'other' is not among joint" in capsys.readouterr().err
