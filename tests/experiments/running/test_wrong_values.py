"""Wrong values of a configuration: each is one line that names its key and what is allowed."""

import copy
import math

import lightning
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf, open_dict

from dolens.alignment.measurement import read_measurements
from dolens.alignment.pose import Pose
from dolens.alignment.unmodelled import unmodelled_of
from dolens.errors import InputError
from dolens.experiments.camera.lens_optimizer import CameraOptimizer
from dolens.experiments.poses.accuracy_tasks import BasinSettings
from dolens.experiments.poses.fit_plan import fit_plan, plain_imager
from dolens.experiments.poses.triplet_alignment import Misalignments
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.main import machine_fault, reason_of
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens
from dolens.experiments.settings import total_steps
from dolens.optimize import MeritSettings
from dolens.optimize.variables import DesignVariables
from dolens.prescriptions import load_lens
from dolens.sensor.pixels import Sensor
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
    "ckpt_path=true": "ckpt_path: true; allowed: a text or null",
    "scheduler.T_max=0": "scheduler.T_max: 0; allowed: an integer of 1 or more",
    "optimizer.network.lr=abc": "optimizer.network.lr: 'abc'; allowed: a number",
    "optimizer.least_squares=abc": "optimizer.least_squares: 'abc'; allowed: a mapping",
    "readout.reference_f_number=true": "readout.reference_f_number: true; allowed: a number",
    "scheduler.eta_min=-1": "scheduler.eta_min: -1; allowed: a number of 0 or more",
    "threads=1.5": "threads: 1.5; allowed: an integer of 1 or more",
    "train=never": "train: 'never'; allowed: true or false",
    "matmul_precision=hihg": "matmul_precision: 'hihg' is unknown; did you mean",
    "lens_dtype=float16": "lens_dtype: 'float16' is unknown; did you mean",
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
        MeritSettings(fields=[]).conditions_of(lightning.LightningModule())


def test_a_setting_is_named_as_the_user_wrote_it_where_another_one_refers_to_it(camera):
    error = InputError("renderer: size must be odd and at least 3, not 64")
    assert reason_of(error, camera) == f"{error} (set by psf_size)"
    direct = InputError("renderer.sensor: height must be at least 1")
    assert reason_of(direct, camera) == str(direct)
    assert reason_of(InputError("psf_size: 64"), camera) == "psf_size: 64"


def test_a_schedule_without_an_end_is_named_by_the_setting_that_lacks_it():
    assert total_steps(6, 50) == 300 and total_steps(6, 50, 2) == 150
    with pytest.raises(InputError, match=r"^trainer\.max_epochs: None; allowed"):
        total_steps(None, 50)
    with pytest.raises(InputError, match=r"^data\.steps_per_epoch: 'a'; allowed"):
        total_steps(6, "a")


# Made of settings within settings: each is refused by the class that takes them.
NESTED = {
    "optimizer.least_squares.every: 1.5": lambda: CameraOptimizer(
        torch.optim.Adam, "adam", {"every": 1.5}
    ),
    "optimizer.least_squares.trust_radius: inf": lambda: CameraOptimizer(
        torch.optim.Adam, "adam", {"trust_radius": math.inf}
    ),
    "merit.quality: 'foo'": lambda: MeritSettings(quality="foo"),
    "merit.quality: '-1.5'": lambda: MeritSettings(quality=-1.5),
    "merit.reference: 'foo'": lambda: MeritSettings(reference="foo"),
    "merit.max_vignetting: -1": lambda: MeritSettings(max_vignetting=-1),
    "merit.sampling_options.rings: 'a'": lambda: MeritSettings(sampling_options={"rings": "a"}),
    "imager.rim: [1, 2]": lambda: plain_imager(Sensor(8, 8, 0.01), 550.0, {"rim": [1, 2]}),
    "cases.a.background: 'abc'": lambda: unmodelled_of({"background": "abc"}, "cases.a"),
    "centroid_weight: -1": lambda: fit_plan({}, [], None, -1),
    "stages: none": lambda: fit_plan({"a": {}}, []),
    "basin.centroid_weights: -1": lambda: BasinSettings({}, [], [-1]),
    "demo.decenter_x: [1, 2]": lambda: Misalignments(
        {"element": "a", "decenter_x": [1, 2]}, 3, 0.1, 0.1, 0.0, 0.0, 0
    ),
    "measurement: 3; allowed": lambda: read_measurements(3, 1),
    "measurement: unknown key 'a'": lambda: read_measurements([{"a": 1}], 1),
    "sensor: height and width must be at most": lambda: Sensor(10**12, 8, 0.01),
}


@pytest.mark.parametrize("said", NESTED)
def test_a_setting_within_settings_is_refused_by_its_name(said):
    with pytest.raises(InputError) as error:
        NESTED[said]()
    assert str(error.value).startswith(said)


@pytest.mark.parametrize(
    "places",
    [{"sources": [[0.0, 1.0]]}, {"sources": [math.nan]}, {"planes": [[]]}, {"planes": []}],
)
def test_places_of_a_bench_are_numbers(root, places):
    lens = load_lens(root / "conf/lens/la1131.yaml", dtype=torch.float64)
    given = {"sources": [[0.0, 0.0, -500.0]], "planes": [0.0], **places}
    with pytest.raises(InputError, match=f"^{next(iter(places))}: "):
        Pose(lens, given["sources"], {}, given["planes"])


@pytest.mark.parametrize("wrong", [True, "a", math.nan, [1, 2]])
def test_a_bound_of_a_variable_is_a_number(root, wrong):
    lens = load_lens(root / "conf/lens/la1131.yaml")
    with pytest.raises(InputError, match=r"^variable 'sensor_distance': upper must be a number"):
        DesignVariables(lens, {"sensor_distance": {"upper": wrong}})


def test_memory_that_is_not_there_is_a_fault_of_the_machine():
    reason = "DefaultCPUAllocator: can't allocate memory: you tried to allocate 1536 bytes."
    fault = machine_fault(RuntimeError(f"[enforce fail at alloc_cpu.cpp:127] err == 0. {reason}"))
    assert fault is not None and fault.startswith("there is not enough memory (can't allocate")
    assert machine_fault(RuntimeError("shape '[3]' is invalid")) is None
