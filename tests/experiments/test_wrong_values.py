"""Wrong values of a configuration: each is one line that names its key and what is allowed."""

import copy

import lightning
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf, open_dict

from dolens.errors import InputError
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.failed_parts import reason_of
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens
from dolens.optimize import MeritSettings
from tests.experiments.conftest import composing

WRONG = {
    "trainer.max_epochs=1.5": "trainer.max_epochs: 1.5; allowed: an integer or null",
    "trainer.enable_model_summary=3": "trainer.enable_model_summary: 3; allowed: true or false",
    "renderer.sensor.height=1.5": "renderer.sensor.height: 1.5; allowed: an integer",
    "renderer.sensor.pixel_pitch=[]": "renderer.sensor.pixel_pitch: []; allowed: a number",
    "learning_rates.optics=abc": "learning_rates.optics: 'abc'; allowed: a number",
    "learning_rates.network=nan": "learning_rates.network: nan; allowed: a number",
    "scene.wavelengths=null": "scene.wavelengths: null; allowed: a list, each a number",
    "scene.wavelengths=[[]]": "scene.wavelengths: [[]]; allowed: a list, each a number",
    "network.width=foo": "network.width: 'foo'; allowed: an integer",
    "optimizer.network.weight_decay=-1": "optimizer.network: Invalid weight_decay value: -1",
    "optimizer.network.betas=[2,3]": "optimizer.network: Invalid beta parameter at index 0: 2",
    "seed=abc": "seed: 'abc'; allowed: an integer",
    "seed=-1": "seed: -1; allowed: an integer from 0 to 4294967295",
    "threads=0": "threads: 0; allowed: an integer of 1 or more",
    "trainer.max_epochs=-2": "trainer.max_epochs: -2; allowed: an integer of -1 or more",
    "trainer.check_val_every_n_epoch=0": (
        "trainer.check_val_every_n_epoch: 0; allowed: an integer of 1 or more"
    ),
    "lens.sensor.distance=-5": "lens.sensor.distance: -5 mm; the sensor must stand behind",
    "ckpt_path=true": "ckpt_path: True; allowed: a text, or null",
    "scheduler.T_max=0": "scheduler.T_max: 0; allowed: an integer of 1 or more",
    "scheduler.eta_min=-1": "scheduler.eta_min: -1; allowed: a number of 0 or more",
}


@pytest.fixture(scope="module")
def camera(root, tmp_path_factory):
    with composing(root, tmp_path_factory.mktemp("composed")) as build:
        yield build("experiment=wavefront_coding")


@pytest.mark.parametrize("override", WRONG)
def test_a_wrong_value_is_refused_by_its_key_before_anything_is_made(camera, override):
    cfg = copy.deepcopy(camera)
    (parsed,) = OverridesParser.create().parse_overrides([override])
    with open_dict(cfg):
        OmegaConf.update(cfg, parsed.key_or_group, parsed.value(), merge=False)
    with pytest.raises(InputError) as error:
        build_lens(RunSettings.of(checked(cfg)))
    assert str(error.value).startswith(WRONG[override])


def test_what_others_refuse_is_named_by_its_setting():
    trainer = {"_target_": "lightning.Trainer", "accelerator": "foo", "logger": False}
    with pytest.raises(InstantiationException) as error:
        instantiate({"trainer": trainer})
    said = reason_of(error.value)
    assert said.startswith("trainer: Trainer cannot be made with these settings (You selected an")
    assert "\n" not in said


def test_a_merit_without_fields_is_refused():
    with pytest.raises(InputError, match=r"merit\.fields: is an empty list"):
        MeritSettings(fields=[]).fields_of(lightning.LightningModule())
