"""Wrong values that a run meets as it makes its parts: one line each, before any work."""

import pytest
from hydra.errors import HydraException

from dolens.experiments.running.command_line import explained
from tests.experiments.tiny_experiment import CAMERA

# What the parts of a run refuse as they are made.
IN_A_CAMERA = {
    "lens.surfaces.1.material=NBK7": "surface 1: unknown material 'NBK7'; did you mean 'N-BK7'",
    "+lens.elements.front={surfaces: [1, 3], tiltx: 0.1}": (
        "element front: unknown key 'tiltx'; did you mean"
    ),
    "~lens.surfaces.2.thickness": "surface 2: 'thickness' is missing",
    "lens.surfaces.1.radius=5": "surface 1: semi_diameter 6.35 mm exceeds the surface",
    "scene.depths=[8000,-1]": "depth -1 mm lies inside the lens",
    "test=false": "needs test=true",
    "loss.perceptual=vgg": "auto, vgg16, download, vgg16_edges, none",
    "readout.pattern=RGBG": "'RGBG' is unknown; did you mean",
    "readout.bits=0": "bits is 0; allowed: null, or a whole number",
    "+variables={surfaces.5.x4: {scale: 1.0}}": "has no parameter 'surfaces.5.x4'",
    "learning_rates.optics=inf": "learning_rates",
    "renderer.sensor.height=8": "renderer.sensor",
}
# Of a search for a lens, where the merit and its optimizer take them.
IN_A_DESIGN = {
    "merit.quality=spot": "merit.quality: 'spot' is unknown",
    "merit.sampling=grid": "merit.sampling: 'grid' is unknown",
    "merit.sampling_options.count=-3": "count: -3; allowed: 1 or more rays along each side",
    "merit.sampling_options.count=2.5": "merit.sampling_options.count: 2.5; allowed: an integer",
    "merit.sampling_options.half_width=-1": "half_width: -1 mm; allowed: a positive number",
    "merit.sampling_options.rings=3": "merit.sampling_options: unknown key 'rings'",
    "merit.quality_options.radius_um=3": "merit.quality_options: unknown key 'radius_um'",
    "merit.reference_spectrum=both": "reference_spectrum: 'both' is unknown",
    "merit.operands=[abc]": "merit.operands: ['abc']; allowed: a list, each a mapping",
    "merit.fields=[[0]]": "merit.fields: [0]; allowed: (x, y)",
    "merit.field_weights=[inf]": "merit.field_weights: give 1 numbers",
    "merit.field_weights=[1.0,2.0]": "merit.field_weights: give 1 numbers",
    "merit.max_vignetting=2": "merit.max_vignetting: 2; allowed: 0 to 1",
    "merit.wavelengths=[]": "merit.wavelengths: lens ",
    "evaluation=3": "evaluation: 3; allowed: MeritSettings or null",
    "module.mtf_max_frequency=-1": "mtf_max_frequency: -1; allowed: a positive number",
    "optimizer.many.lr=abc": "optimizer.many.lr: 'abc'; allowed: a number",
    "optimizer.few=foo": "optimizer.few: 'foo'; allowed: what can be called",
    "optimizer.few.damping=foo": "optimizer.few: damping: 'foo' is unknown",
    "optimizer.few.max_trials=0": "optimizer.few: max_trials must be at least 1",
    "optimizer.max_variables=-1": "optimizer.max_variables: -1; allowed: 0 or more",
    "variables=null": "variables: there are none",
    "semi_diameters=free": "semi_diameters: 'free' is unknown",
    "start={surfaces.1.radius: 20}": "surfaces.1.radius",
    "start={surfaces.1.conic: {times: 2}}": "unknown key 'times'",
    "data.iterations=0": "data.iterations: 0; allowed",
}


@pytest.mark.parametrize("override", IN_A_CAMERA)
def test_a_wrong_value_of_a_camera_is_refused_before_training(refused, override):
    refused(IN_A_CAMERA[override], *CAMERA, override)


@pytest.mark.parametrize("override", IN_A_DESIGN)
def test_a_wrong_value_of_a_design_is_refused_by_its_key(refused, override):
    refused(IN_A_DESIGN[override], "experiment=asphere", override)


def test_files_that_are_not_there_are_named(refused, tmp_path):
    weights = ["loss.perceptual=vgg16", "loss.vgg16_weights=nowhere.pth"]
    refused("nowhere.pth", *CAMERA, *weights)
    refused(f"{tmp_path}: no images", *CAMERA, "data=image_folder", f"data.root={tmp_path}")


def test_hydra_s_refusal_of_a_wrong_name_names_the_nearest(composed):
    with pytest.raises(HydraException) as caught:
        composed("experiment=asphere", "merit.sampling_optoins.count=3")
    assert "did you mean 'sampling_options'" in explained(caught.value)
