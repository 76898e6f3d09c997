"""Run folders become tables: what is the same but for the seed, and what a row gains."""

import json
import re

import pytest
import torch
import yaml

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import TABLE, scores_by_photograph
from dolens.experiments.running.compared_runs import grouped, read_run
from dolens.experiments.tables import write_table
from scripts.compare import gain, main


def made(folder, experiment, seed, psnr, choices=None, views=("axis",), **config):
    """A run folder; `psnr` is one number, or scores (photographs, views) to keep as a table."""
    (folder / ".hydra").mkdir(parents=True)
    chosen = {"experiment": experiment, "hydra/launcher": "basic", **(choices or {})}
    (folder / ".hydra/hydra.yaml").write_text(
        yaml.safe_dump({"hydra": {"runtime": {"choices": chosen}}})
    )
    config = {"seed": seed, "train": True, "data": {"seed": "${seed}"}, **config}
    (folder / ".hydra/config.yaml").write_text(yaml.safe_dump(config))
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


def printed(capsys, *arguments):
    assert main([*map(str, arguments), "--metrics", "psnr_db"]) == 0
    return capsys.readouterr().out.splitlines()


def test_means_and_spreads_over_seeds(tmp_path, capsys):
    folders = [
        made(tmp_path / "a", "joint", 0, 26.0, threads=1),
        made(tmp_path / "b", "joint", 1, 28.0, threads=2, ckpt_path="last.ckpt"),
    ]
    lines = printed(capsys, *folders)
    assert "| psnr_db | seeds | photographs | axis | worst |" in lines
    assert "| joint | 2 | ? | 27.00 ± 1.00 | 27.00 ± 1.00 |" in lines


def test_runs_of_other_networks_or_data_are_other_rows(tmp_path, capsys):
    wiener, unet = {"network": "wiener_unet"}, {"network": "unet"}
    folders = [
        made(tmp_path / "a", "joint", 0, 26.0, wiener, network={"width": 32, "depth": 3}),
        made(tmp_path / "b", "joint", 0, 24.0, unet, network={"channels": 8}),
        made(tmp_path / "c", "joint", 1, 20.0, unet, network={"channels": 16}),
        made(tmp_path / "d", "alone", 0, 23.0, unet, network={"channels": 8}),
    ]
    lines = printed(capsys, *folders)
    assert "| joint (network=wiener_unet) | 1 | ? | 26.00 ± 0.00 | 26.00 ± 0.00 |" in lines
    for channels, psnr in ((8, "24.00"), (16, "20.00")):
        name = f"joint (network=unet, network.channels={channels})"
        assert f"| {name} | 1 | ? | {psnr} ± 0.00 | {psnr} ± 0.00 |" in lines
    assert "| alone | 1 | ? | 23.00 ± 0.00 | 23.00 ± 0.00 |" in lines


def test_rows_name_the_keys_that_differ(tmp_path):
    folders = [
        made(tmp_path / "a", "joint", 0, 26.0, data={"batch_size": 2, "root": "x"}),
        made(tmp_path / "b", "joint", 1, 26.0, data={"batch_size": 4, "root": "x"}),
        made(tmp_path / "c", "joint", 0, 26.0, data={"batch_size": 4, "root": "x"}, f_number=11),
    ]
    names = list(grouped([read_run(folder) for folder in folders]))
    assert names == [
        "joint (data.batch_size=2, f_number=unset)",
        "joint (data.batch_size=4, f_number=unset)",
        "joint (data.batch_size=4, f_number=11)",
    ]


def test_untrained_runs_of_other_checkpoints_are_not_seeds_of_one(tmp_path):
    folders = [
        made(tmp_path / "a", "joint", 0, 26.0, ckpt_path="one.ckpt", train=False),
        made(tmp_path / "b", "joint", 1, 26.0, ckpt_path="two.ckpt", train=False),
    ]
    assert len(grouped([read_run(folder) for folder in folders])) == 2


def test_many_differences_are_counted_and_rows_stay_apart(tmp_path):
    folders = [
        made(tmp_path / str(n), "joint", 0, 26.0, **{f"key{k}": 1 for k in range(7)}, z=n)
        for n in (1, 2)
    ] + [made(tmp_path / "3", "joint", 0, 26.0)]
    names = list(grouped([read_run(folder) for folder in folders]))
    assert len(set(names)) == 3
    assert all("and 3 more" in name for name in names)


def test_the_same_run_twice_is_refused(tmp_path):
    folders = [made(tmp_path / name, "joint", 0, 26.0) for name in ("a", "b")]
    with pytest.raises(InputError, match=r"a and .*b have the same configuration and seed 0"):
        grouped([read_run(folder) for folder in folders])


def test_runs_with_other_depths_have_a_table_of_their_own(tmp_path, capsys):
    folders = [
        made(tmp_path / "a", "joint", 0, 26.0, views=("8m", "6m")),
        made(tmp_path / "b", "near", 0, 25.0, views=("1m", "2m")),
        made(tmp_path / "c", "alone", 0, 24.0, views=("8m", "6m")),
    ]
    (tmp_path / "b" / "metrics.json").write_text(
        json.dumps({"test/psnr_db/1m": 25.0, "test/psnr_db/2m": 25.5})
    )
    lines = printed(capsys, *folders, "--against", "alone")
    assert "| psnr_db | seeds | photographs | 8m | 6m | worst |" in lines
    assert "| psnr_db | seeds | photographs | 1m | 2m |" in lines
    assert "| near | 1 | ? | 25.00 ± 0.00 | 25.50 ± 0.00 |" in lines
    assert "No gains over alone: it has other views." in lines


def test_runs_without_the_metric_are_listed(tmp_path, capsys):
    design = made(tmp_path / "a", "nikon", 0, 0.0)
    (design / "metrics.json").write_text(json.dumps({"rms_spot_um/final": 1.0}))
    lines = printed(capsys, design, made(tmp_path / "b", "joint", 0, 26.0))
    assert "No test/psnr_db of: nikon." in lines


def test_gains_are_paired_over_seeds_and_photographs(tmp_path, capsys):
    # Photographs differ by 30 dB and seeds by 2 dB, the gain by nothing.
    generator = torch.Generator().manual_seed(0)
    photographs = 30.0 * torch.rand(20, 1, generator=generator)
    folders = []
    for seed in range(3):
        base = photographs + 2.0 * seed + torch.tensor([0.0, 1.0])
        settings = {"views": ("near", "far")}
        folders += [
            made(tmp_path / f"a{seed}", "joint", seed, base + 0.5, **settings),
            made(tmp_path / f"b{seed}", "alone", seed, base, **settings),
        ]
    lines = printed(capsys, *folders, "--against", "alone", "--json", tmp_path / "gains.json")
    cells = " | ".join(["+0.50 [+0.50, +0.50]"] * 3)
    assert f"| joint - alone | 3 | 20 | {cells} |" in lines
    numbers = json.loads((tmp_path / "gains.json").read_text())
    assert numbers["gain/psnr_db/worst/joint/low"] == pytest.approx(0.5, abs=1e-5)
    assert numbers["gain/psnr_db/far/joint/photographs"] == 20


def test_a_gain_that_photographs_do_not_share_has_a_wide_interval(tmp_path):
    gains = torch.tensor([1.0, -1.0] * 10)[:, None] + 0.1
    runs = grouped(
        [
            read_run(made(tmp_path / "a", "joint", 0, 25.0 + gains)),
            read_run(made(tmp_path / "b", "alone", 0, torch.full((20, 1), 25.0))),
        ]
    )
    found = gain(runs["joint"], runs["alone"], "psnr_db", "axis")
    # s/√n = 0.23 and t = 2.09.
    assert found.estimate == pytest.approx(0.1, abs=1e-5)
    assert found.low == pytest.approx(0.1 - 0.48, abs=0.05)
    assert found.high == pytest.approx(0.1 + 0.48, abs=0.05)


def test_runs_on_other_photographs_have_no_interval(tmp_path, capsys):
    folders = [
        made(tmp_path / "a", "joint", 0, torch.full((3, 1), 26.0)),
        made(tmp_path / "b", "alone", 0, torch.full((4, 1), 25.0)),
        made(tmp_path / "c", "old", 1, 24.0),
    ]
    lines = printed(capsys, *folders, "--against", "alone")
    assert "| joint - alone | 1 | not paired | +1.00 | +1.00 |" in lines
    assert any(re.match(r"\| old - alone \| 0 \|.*no seed in common", line) for line in lines)


def test_what_to_compare_with_is_one_row(tmp_path, capsys):
    folders = [
        made(tmp_path / "a", "joint", 0, 26.0, data={"batch_size": 2}),
        made(tmp_path / "b", "joint", 0, 27.0, data={"batch_size": 4}),
    ]
    with pytest.raises(SystemExit):
        main([*map(str, folders), "--against", "other"])
    assert "'other' is not among joint (data.batch_size=2)" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*map(str, folders), "--against", "joint"])
    assert "'joint' is several rows" in capsys.readouterr().err
    lines = printed(capsys, *folders, "--against", "joint (data.batch_size=2)")
    assert any(line.startswith("| joint (data.batch_size=4) - joint (data.") for line in lines)


def test_a_folder_that_is_no_run_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path)])
    assert "is no finished run folder: metrics.json is missing" in capsys.readouterr().err
