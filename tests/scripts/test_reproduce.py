"""A run folder holds what it takes to repeat the run."""

import runpy
import subprocess
import sys

import pytest

from tests.experiments.conftest import finished_run
from tests.experiments.tiny_experiment import QUIET, UNPICTURED


def test_an_old_run_is_repeated_from_its_overrides(
    root, tmp_path, monkeypatch, capfd, dolens_train
):
    """What the script starts by another process runs in this one."""
    kept = [
        "experiment=cooke_sensitivity",
        "fields=[[0,0]]",
        "wavelengths=[587.5618]",
        "lenses=20",
        "module.spots.pupil.rings=3",
        "module.spots.pupil.arms=6",
        *(UNPICTURED, QUIET),
    ]
    folder = finished_run(root, tmp_path, *kept)
    script = root / "scripts/reproduce.py"
    started = subprocess.run

    def run_here(command, **options):
        if command[:2] != [sys.executable, str(root / "train.py")]:
            return started(command, **options)
        dolens_train(options["cwd"], *command[2:])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", run_here)
    monkeypatch.setattr(sys, "argv", [str(script), str(folder)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    said = capfd.readouterr()
    assert ended.value.code == 0, said.err
    assert said.out.splitlines()[-1] == "reproduced"
