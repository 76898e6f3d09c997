"""What an evaluation may change of the run that it evaluates."""

from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from dolens.errors import InputError
from dolens.experiments.running.command_line import read_override
from dolens.experiments.running.recorded_run import RecordedRun

# What decides the work of a run, and not what is evaluated.
_OF_THE_RUN = {
    "experiment": "another experiment is another run: train it",
    "module": "another module is another run: train it",
    "train": "an evaluation does not train",
    "test": "an evaluation is a test",
    "ckpt_path": "name the checkpoint by --checkpoint",
}
# Places of the configuration whose change makes another camera, or changes training alone.
_CAMERA = (
    ("network",),
    ("variables",),
    ("module", "variables"),
    ("module", "reconstruction", "network"),
)
_TRAINING = ("optimizer", "scheduler", "learning_rates", "operands", "discriminator")


def refuse_other_work(overrides: Sequence[str]) -> None:
    """Refuse overrides that decide the work of a run, and not what is evaluated.

    Raises:
        InputError: for the first of them; or an override cannot be read, or is a sweep.
    """
    for text in overrides:
        read_override(text)
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    for override in parsed:
        key = override.key_or_group
        if override.is_sweep_override():
            raise InputError(
                f"{override.input_line}: an evaluation is one; give one value at a time"
            )
        if key.startswith("hydra"):
            raise InputError(f"{key}: Hydra has no job here; --name names the folder")
        if key in _OF_THE_RUN:
            raise InputError(f"{key}: {_OF_THE_RUN[key]}")


def with_own_calibration(record: RecordedRun, overrides: Sequence[str]) -> list[str]:
    """Return the overrides, with the depths that the run's network has its functions of.

    A camera does not know the depth of what it looks at: were its functions those of the scene that
    it is judged by, a scene of one depth would tell it.
    """
    found, views = list(overrides), (record.config["module"] or {}).get("views")
    if not found or not isinstance(views, Mapping) or "psf_size" not in views:
        return found
    scene = views.get("scene")
    depths = views.get("psf_depths") or (scene.get("depths") if isinstance(scene, dict) else None)
    asked = any(text.lstrip("+").startswith("views.psf_depths=") for text in found)
    if depths is None or asked:
        return found
    return [f"views.psf_depths={list(depths)}", *found]


def refuse_another_camera(
    changed: Sequence[tuple[Any, ...]], config: Mapping[str, Any], perturb_lens: bool
) -> None:
    """Refuse settings that make another camera than the run has trained, or only training reads.

    Args:
        changed: places of the configuration that have another value than in the run.
        config: the configuration of the evaluation.
        perturb_lens: whether parameters of the lens may have other values.

    Raises:
        InputError: for the first of them.
    """
    for place in changed:
        name = ".".join(map(str, place))
        if any(place[: len(part)] == part for part in _CAMERA):
            raise InputError(
                f"{name}: another value makes another camera than the run has trained; train it"
            )
        if place[0] in _TRAINING:
            raise InputError(f"{name}: this setting is of training alone, and nothing is trained")
        if place[0] == "lens" and not perturb_lens:
            raise InputError(
                f"{name}: another value makes another lens than the run has trained; "
                "--perturb-lens evaluates the camera with it all the same"
            )
        judged = config.get("evaluation_renderer") is not None
        if judged and place[0] == "renderer" and place[1:2] != ("sensor",):
            raise InputError(
                f"{name}: renderer makes images for training; test images are made by "
                "evaluation_renderer"
            )
