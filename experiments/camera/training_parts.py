"""Parts of a camera's training: what it refuses, its parameter groups, and its summary."""

from typing import Any

import lightning

from dolens.errors import InputError
from dolens.experiments.camera.adversary import Adversary
from dolens.experiments.camera.as_built import Manufacture
from dolens.experiments.camera.lens_steps import variable_numbers
from dolens.experiments.camera.made_lens_scores import front_numbers
from dolens.experiments.camera.restoration_gain import gain_numbers


def check_sharing(
    trainer: lightning.Trainer, adversary: Adversary | None, manufacture: Manufacture | None
) -> None:
    """Refuse what discriminators and lenses that are made cannot share.

    Args:
        trainer: of the run.
        adversary: makes a step for every batch.
        manufacture: makes lenses in one process.

    Raises:
        InputError: the line names the setting.
    """
    batches = trainer.accumulate_grad_batches
    if batches > 1 and adversary is not None:
        raise InputError(
            f"trainer.accumulate_grad_batches: {batches}; allowed with a discriminator: 1, as "
            "it makes a step for every batch"
        )
    if manufacture is not None and trainer.world_size > 1:
        raise InputError(
            f"trainer.devices: {trainer.world_size}; allowed with tolerances: 1, as one "
            "process makes the lenses of a step"
        )


def parameter_groups(camera: Any) -> list[dict[str, Any]]:
    """Return the optimizer's groups: the network, and the lens's variables unless they move apart.

    Args:
        camera: a `CameraModule`.
    """
    rates = camera.learning_rates
    network = {"params": list(camera.network.parameters()), "lr": rates.network, "name": "network"}
    if not len(camera.variables) or camera.lens_steps.apart:
        return [network]
    return [network, {"params": [camera.variables.scaled], "lr": rates.optics, "name": "optics"}]


def summary_numbers(camera: Any) -> dict[str, float]:
    """Return the variables, intervals of scores, and costs of a camera that was tested.

    Args:
        camera: a `CameraModule`.
    """
    numbers = {n: float(v) for n, v in variable_numbers(camera.variables()).items()}
    for stage, scores in camera.test_scores.items():
        numbers |= scores.numbers(stage) | gain_numbers(scores, stage)
    numbers["network/pretrained"] = float(camera.network.pretrained)
    if hasattr(camera.loss, "perceptual_available"):  # a loss of a user's own may know no such
        numbers["loss/perceptual_available"] = float(camera.loss.perceptual_available)
    numbers["cost/rays"] = float(camera.views.rays())
    numbers |= camera.views.numbers() | camera.evaluation.costs()
    if camera.made_scores is not None:
        numbers |= camera.made_scores.numbers() | front_numbers(camera.made_front)
    return numbers | camera.lens_steps.numbers() | camera.costs.numbers()
