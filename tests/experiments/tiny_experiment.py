"""Experiments at a size that trains in seconds; the path is the same."""

QUIET = "+trainer.enable_progress_bar=false"
UNPICTURED = "callbacks.pictures=null"
UNTESTED = [UNPICTURED, "test=false", "objective=train/loss"]
ONE_EPOCH = "trainer.max_epochs=1"
SHORT = [
    "data.evaluation_crops_per_photograph=1",
    "data.steps_per_epoch=2",
    "trainer.max_epochs=2",
    "+trainer.limit_val_batches=1",
    "+trainer.limit_test_batches=1",
    "trainer.log_every_n_steps=1",
    "loss.perceptual=none",
    QUIET,
]
TINY = [
    *SHORT,
    "renderer.sensor.height=24",
    "renderer.sensor.width=24",
    "renderer=rays",
    "renderer.pupil_samples=2",
    "evaluation_renderer.pupil_samples=2",
    "reference_renderers=none",
    "miscalibrations=none",
    "views.psf_size=33",
    "views.psf_pupil_samples=8",
    "data.margin=16",
]
TINY_NETWORK = ["network=feature_wiener", "network.width=4", "network.depth=2"]
CAMERA = ["experiment=wavefront_coding", *TINY, *TINY_NETWORK]
# The camera of `tiny_run`, whose network moves.
TRAINED = [*CAMERA, ONE_EPOCH, "learning_rates.network=0.05"]

TINY_DOUBLET = [
    *SHORT,
    "experiment=large_fov_doublet",
    "renderer.sensor.height=32",
    "renderer.sensor.width=32",
    "variables.sensor_distance.initial=45.0",  # out of focus, as published
    "psf_size=15",
    "evaluation_renderer=rays",
    "evaluation_renderer.pupil_samples=2",
    "data.margin=12",
    "optimizer.lens=adam",
    "network=field_pyramid",
    "network.width_multiplier=0.25",
    "network.weights=none",
]
FIXED_WINDOWS = ["renderer.fields=[1,1]"]
# The lens takes turns with the network, and is not designed first.
IN_TURNS = [
    "optimizer.lens=dls",
    "optimizer.least_squares.every=2",
    "optimizer.least_squares.first_iterations=0",
]
