"""Settings that nothing reads are errors; defaults that are not used are none."""

import copy

import pytest
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.refused_settings import References

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
    "keys within groups": ["network.by_depth=true", "evaluation_renderer.pupil_samples=2"],
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
        checked(composed(*overrides))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", READ)
def test_what_is_read_is_allowed(composed, case):
    checked(composed("experiment=wavefront_coding", *READ[case]))


def test_a_key_of_an_experiment_whose_module_does_not_take_it(composed):
    cfg = composed("experiment=large_fov_doublet_spots", "~module.merit")
    with pytest.raises(InputError, match=r"^merit: nothing in experiment="):
        checked(cfg)


INTERPOLATED = """
module: {views: "${views}", name: "a ${light.name}", text: '\\${quoted}', all: ["${seeds}"]}
views: {renderer: "${renderer}", depth: "${.renderer.rays}", by_name: "${oc.select:chosen,1}"}
renderer: {rays: "${counts.rays}", size: "${oc.dict.values:sizes}"}
counts: {rays: 3, others: 4}
light: {name: lamp, power: 2.0}
seeds: [1, 2]
chosen: 5
sizes: {a: 1}
quoted: 6
unread: {renderer: "${renderer}"}
"""
SURE = {"views", "renderer", "renderer.rays", "counts", "counts.rays", "light", "light.name"}


def test_what_is_named_plainly_is_needed_and_nothing_else_is_said_to_be():
    """Against resolving without each setting in turn."""
    whole = OmegaConf.create(INTERPOLATED)
    references = References.of(OmegaConf.to_container(whole), ["module"])
    for path in (*SURE, "views.depth", "seeds", "counts.others", "light.power", "chosen", "sizes",
                 "quoted", "unread", "unread.renderer"):  # fmt: skip
        without = copy.deepcopy(whole)
        parent, _, last = path.rpartition(".")
        (OmegaConf.select(without, parent) if parent else without).pop(last, None)
        try:
            same = OmegaConf.to_container(without.module, resolve=True) == OmegaConf.to_container(
                whole.module, resolve=True
            )
        except OmegaConfBaseException:
            same = False
        assert not (same and references.need(path)), path
        assert path not in SURE or references.need(path), path


UNKNOWN = {
    "beside a network": ("+network.widht=3", "network: unknown key 'widht'; did you mean 'width'?"),
    "beside data": ("+data.batch_sise=3", "data: unknown key 'batch_sise'; did you mean"),
    "of a sensor within a renderer": (
        "+renderer.sensor.pitch=1",
        "renderer.sensor: unknown key 'pitch'; did you mean 'pixel_pitch'?",
    ),
    "of a module": (
        "+module.reconstruction.view_nrom=2",
        "module.reconstruction: unknown key 'view_nrom'; did you mean 'view_norm'?",
    ),
    "of a callback": ("+callbacks.pictures.size=9", "callbacks.pictures: unknown key 'size'"),
    "of an optimizer": (
        "+optimizer.network.beta=1",
        "optimizer.network: unknown key 'beta'; did you mean 'betas'?",
    ),
    "a class that is not there": (
        "network._target_=dolens.reconstruction.UNett",
        r"network._target_: 'dolens.reconstruction.UNett' cannot be found",
    ),
    "a class that makes itself from a surface": (
        "+lens.surfaces.1._target_=os.system",
        "lens.surfaces.1: unknown key '_target_'; a prescription is data and makes nothing",
    ),
    "a class that makes itself from a lens file": (
        "+lens.elements.front._target_=os.system",
        "lens.elements.front: unknown key '_target_'; a prescription is data and makes nothing",
    ),
}


@pytest.mark.parametrize("case", UNKNOWN)
def test_a_key_that_no_class_takes_is_one_line_with_the_nearest(composed, case):
    override, message = UNKNOWN[case]
    with pytest.raises(InputError) as caught:
        checked(composed("experiment=wavefront_coding", override))
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


def test_the_published_lens_is_data_too(composed):
    with pytest.raises(
        InputError, match=r"^published: unknown key .*; a prescription is data and makes nothing"
    ):
        checked(composed("experiment=asphere", "+published._target_=os.system"))


def test_a_run_refuses_before_any_work(refused, tmp_path):
    refused("discriminator=double_scale", *UNREAD["a group"][0])
    assert not (tmp_path / "run" / "run.json").exists()


def test_no_base_is_offered_as_an_experiment(root):
    """Files that several experiments build on lie where no group has them."""
    assert not list((root / "conf/experiment").glob("*/*"))
