"""Settings that nothing reads are errors; defaults that are not used are none."""

import pytest

from dolens.errors import InputError
from experiments.running.training import TAKEN
from experiments.running.unread_settings import refuse_unread

UNREAD = {
    "a group": (["experiment=asphere", "discriminator=double_scale"], "discriminator="),
    "a new key": (
        ["experiment=asphere", "+operands=[{kind: efl, target: 100}]"],
        "operands:",
    ),
    "a group of images for a lens alone": (["experiment=nikon", "network=unet"], "network=unet:"),
    "one that is the default of other experiments": (
        ["experiment=nikon", "network=wiener_unet"],
        "network=wiener_unet:",
    ),
    "a group in a place of its own": (
        ["experiment=wavefront_coding", "+lens@elsewhere=nikon"],
        "elsewhere:",
    ),
}
READ = {
    "a group": ["network=unet"],
    "keys within groups": ["network.depth=2", "evaluation_renderer.pupil_samples=2"],
    "a key by way of another one": ["read_noise=0.01"],
    "an argument of a resolver": ["data.steps_per_epoch=7"],
    "a group without keys of its own": ["search=seeds"],
    "what is taken away": ["callbacks.pictures=null", "~callbacks.best"],
    "something empty": ["+wishes=[]"],
    "an adversarial term": ["discriminator=double_scale"],
    "operands": ["operands=[{kind: efl, target: 100}]"],
    "a tag of the run folder": ["+tag=3", "hydra.run.dir=outputs/${tag}"],
    "a default of a group, named": ["discriminator=none"],
}


@pytest.mark.parametrize("case", UNREAD)
def test_what_nothing_reads_is_one_line(composed, case):
    overrides, named = UNREAD[case]
    with pytest.raises(InputError, match=f"^{named}") as caught:
        refuse_unread(composed(*overrides), TAKEN)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", READ)
def test_what_is_read_is_allowed(composed, case):
    refuse_unread(composed("experiment=wavefront_coding", *READ[case]), TAKEN)


def test_a_key_of_an_experiment_whose_module_does_not_take_it(composed):
    cfg = composed("experiment=large_fov_doublet_spots", "~module.merit")
    with pytest.raises(InputError, match=r"^merit: nothing in experiment="):
        refuse_unread(cfg, TAKEN)


def test_a_run_refuses_before_any_work(refused, tmp_path):
    refused("discriminator=double_scale", *UNREAD["a group"][0])
    assert not (tmp_path / "run" / "run.json").exists()
