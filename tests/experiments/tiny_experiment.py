"""Experiments at a size that trains in seconds; the path is the same."""

from pathlib import Path

TINY = [
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
    "data.evaluation_crops_per_photograph=1",
    "data.steps_per_epoch=2",
    "trainer.max_epochs=2",
    "+trainer.limit_val_batches=1",
    "+trainer.limit_test_batches=1",
    "+trainer.enable_progress_bar=false",
    "trainer.log_every_n_steps=1",
    "loss.perceptual=none",
]
TINY_NETWORK = ["network=feature_wiener", "network.width=4", "network.depth=2"]

TINY_DOUBLET = [
    "experiment=large_fov_doublet",
    "renderer.sensor.height=32",
    "renderer.sensor.width=32",
    "variables.sensor_distance.initial=45.0",  # out of focus, as published
    "psf_size=15",
    "evaluation_renderer=rays",
    "evaluation_renderer.pupil_samples=2",
    "data.margin=12",
    "data.steps_per_epoch=2",
    "data.evaluation_crops_per_photograph=1",
    "trainer.max_epochs=2",
    "+trainer.limit_val_batches=1",
    "+trainer.limit_test_batches=1",
    "+trainer.enable_progress_bar=false",
    "trainer.log_every_n_steps=1",
    "optimizer.lens=adam",
    "network=field_pyramid",
    "network.width_multiplier=0.25",
    "network.weights=none",
    "loss.perceptual=none",
]
FIXED_WINDOWS = ["renderer.fields=[1,1]"]


def figure_names(folder: Path) -> set[str]:
    """The figures that a run left, none of them empty."""
    files = list((folder / "figures").iterdir())
    assert all(file.suffix == ".png" and file.stat().st_size > 5000 for file in files), files
    return {file.stem for file in files}
