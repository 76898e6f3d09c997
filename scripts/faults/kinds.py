"""One experiment of each kind, at a size that takes seconds."""

from tests.experiments.tiny_experiment import FIXED_WINDOWS, TINY, TINY_DOUBLET, TINY_NETWORK

# The same numbers on every machine, and processes that can be forked.
COMMON = ["threads=1", "callbacks.pictures=null"]
# A checkpoint after every step, so that many are written.
_EACH_STEP = ["+callbacks.last.every_n_train_steps=1"]
CAMERA = ["experiment=wavefront_coding", *TINY, *TINY_NETWORK, *_EACH_STEP]
_SMALL_SENSOR = ["sensor.height=32", "sensor.width=32", "sensor.pixel_pitch=0.2208"]
_QUIET = "+trainer.enable_progress_bar=false"

# Those that train: they are resumed from a checkpoint.
TRAINED = {
    "camera, Adam": CAMERA,
    "camera, least squares": [
        *CAMERA,
        "optimizer.lens=dls",
        "optimizer.least_squares.every=2",
        "data.steps_per_epoch=3",
    ],
    "camera, renderer by plan": [
        *(e for e in CAMERA if e not in ("renderer=rays", "renderer.pupil_samples=2")),
        "renderer.tolerance=4.0",
    ],
    "camera, discriminator": [
        *TINY_DOUBLET,
        *FIXED_WINDOWS,
        "discriminator=double_scale",
        *_EACH_STEP,
    ],
    "design, least squares": ["experiment=asphere", _QUIET],
    "design, Adam": [
        "experiment=asphere",
        "optimizer=adam",
        "data.iterations=25",
        "trainer.max_epochs=4",
        _QUIET,
    ],
    "poses": [
        "experiment=misalignment",
        *("~fits.10", "~fits.25", "~fits.30"),
        *_SMALL_SENSOR,
        "photons=100000",
        "imager.rays=4000",
        "monte_carlo=0",
        "stages=[{optimizer: adam, iterations: 3, learning_rate: 0.1},"
        "{optimizer: dls, iterations: 4}]",
        "callbacks.last.every_n_train_steps=1",
        _QUIET,
    ],
}
# Those that measure: they begin anew.
MEASURED = {
    "tolerances": [
        "experiment=cooke_sensitivity",
        "fields=[[0,0],[0,20]]",
        "wavelengths=[587.5618]",
        "lenses=200",
        "module.spots.pupil.rings=3",
        "module.spots.pupil.arms=6",
        _QUIET,
    ],
    "triplet alignment": [
        "experiment=triplet_alignment",
        "fields=[[0,0],[0,14],[-14,0],[14,-6]]",
        "misalignments=3",
        "module.spots.pupil.arms=16",
        "module.simulation_pupil.rings=5",
        "module.simulation_pupil.arms=20",
        "module.iterations=3",
        _QUIET,
    ],
    "bounds of a pose": [
        "experiment=pose_bounds",
        *_SMALL_SENSOR,
        "photons=100000",
        "imager.rays=4000",
        "imager.rim=0.01",
        "~arrangements.five_sources_three_planes",
        "objective=knowledge/three_planes/worst",
        _QUIET,
    ],
}
KINDS = {name: [*overrides, *COMMON] for name, overrides in {**TRAINED, **MEASURED}.items()}
# Tasks for workers: fits from many starts, some seconds of them.
MANY_TASKS = [
    "experiment=pose_accuracy",
    "parts=[basin]",
    *_SMALL_SENSOR,
    "photons=100000",
    "imagers.narrow.rays=20000",
    "imagers.wide.rays=20000",
    "basin.along={elements.lens.tilt_x: [0.0, 1.0, 2.0, 3.0],"
    " elements.lens.decenter_y: [0.0, 0.5, 1.0]}",
    "basin.centroid_weights=[1.0]",
    "basin.photons=1e5",
    "basin.imager.rays=2000",
    "basin.stages=[{optimizer: dls, iterations: 4}]",
    "objective=basin/converged/centroid_weight_1",
    _QUIET,
]
