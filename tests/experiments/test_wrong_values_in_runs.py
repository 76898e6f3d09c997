"""Wrong values that a run meets as it makes its parts: one line each, before any work."""

import os
import pickle

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.running.checkpoints import read_checkpoint
from dolens.experiments.running.command_line import no_choice
from tests.experiments.tiny_experiment import TINY, TINY_NETWORK

# Of a search for a lens, where the merit and its optimizer take them.
WRONG_DESIGN = {
    "merit.sampling_options.count=-3": "count: -3; allowed: 1 or more rays along each side",
    "merit.sampling_options.count=2.5": "merit.sampling_options.count: 2.5; allowed: an integer",
    "merit.sampling_options.half_width=-1": "half_width: -1 mm; allowed: a positive number",
    "merit.operands=[abc]": "merit.operands: ['abc']; allowed: a list, each a mapping",
    "merit.fields=[[0]]": "merit.fields: [0]; allowed: (x, y)",
    "merit.field_weights=[inf]": "merit.field_weights: give 1 numbers",
    "merit.max_vignetting=2": "merit.max_vignetting: 2; allowed: 0 to 1",
    "evaluation=3": "evaluation: 3; allowed: MeritSettings or null",
    "module.mtf_max_frequency=-1": "mtf_max_frequency: -1; allowed: a positive number",
    "optimizer.many.lr=abc": "optimizer.many.lr: 'abc'; allowed: a number",
    "optimizer.few=foo": "optimizer.few: 'foo'; allowed: what can be called",
    "optimizer.few.damping=foo": "optimizer.few: damping: 'foo' is unknown",
    "optimizer.few.max_trials=0": "optimizer.few: max_trials must be at least 1",
    "optimizer.max_variables=-1": "optimizer.max_variables: -1; allowed: 0 or more",
}


@pytest.mark.parametrize("override", WRONG_DESIGN)
def test_a_wrong_value_of_a_design_is_refused_by_its_key(refused, override):
    refused(WRONG_DESIGN[override], "experiment=asphere", override)


@pytest.mark.parametrize("where", ["learning_rates.optics=inf", "renderer.sensor.height=8"])
def test_a_wrong_value_of_a_camera_is_refused_before_training(refused, where):
    key = where.partition("=")[0].rpartition(".")[0]
    refused(key, "experiment=wavefront_coding", *TINY, *TINY_NETWORK, where)


def test_loggers_are_none_by_name_and_null_is_explained(composed):
    assert composed("experiment=asphere", "logger=none").logger is None
    assert no_choice(["-m", "experiment=asphere", "logger=null"]) == (
        "logger=null: logger is chosen by the name of a file "
        "(there are: mlflow, none, tensorboard, wandb)"
    )
    assert no_choice(["experiment=asphere", "seed=3"]) is None


class Bomb:
    """Its pickle leaves a file where it is executed."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return os.mkdir, (str(self.file),)


@pytest.mark.parametrize("form", ["zip", "before 1.6", "pickle"])
def test_a_checkpoint_that_would_execute_something_is_refused(tmp_path, form):
    file, executed = tmp_path / "a.ckpt", tmp_path / "executed"
    if form == "pickle":
        file.write_bytes(pickle.dumps(Bomb(executed), protocol=2))
    else:
        content = {"state_dict": Bomb(executed)}
        torch.save(content, file, _use_new_zipfile_serialization=form == "zip")
    with pytest.raises(InputError, match="is not a safe checkpoint") as error:
        read_checkpoint(file, "ckpt_path: ")
    assert str(error.value).startswith(f"ckpt_path: {file}") and "\n" not in str(error.value)
    assert "weights_only" not in str(error.value)
    assert not executed.exists()
