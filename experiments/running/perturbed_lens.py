"""A trained lens of which some parameters are set to other values, as of a lens that was made."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.base import Camera
from dolens.experiments.experiment import Experiment
from dolens.optics.lens import Lens

_PREFIX = "lens."


def perturbed_state(
    module: Experiment, wanted: Lens, recorded: Lens, state: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return the state of a checkpoint with those values of the lens that a prescription changes.

    A parameter that the changed prescription has as the run's own is the checkpoint's; any other,
    and one that the run's lens does not have (an element's tilt), is that of the changed one.

    Args:
        module: made with the changed lens.
        wanted: the lens of the changed prescription.
        recorded: the lens of the run's own prescription.
        state: of the checkpoint.

    Raises:
        InputError: the module is no camera; a parameter that the run trained is changed, or another
            one while some follow by a solve or a pickup; or the lens has other surfaces.
    """
    if not isinstance(module, Camera):
        raise InputError(f"lens: {type(module).__name__} is no camera; only a camera's lens may be "
                         "set to other values")  # fmt: skip
    own, before = wanted.state_dict(), recorded.state_dict()
    if list(wanted.surfaces) != list(recorded.surfaces):
        raise InputError("lens: other surfaces make another lens, which the run did not train")
    changed = [
        name for name, value in own.items() if name not in before or not _same(value, before[name])
    ]
    trained = [name for name in changed if name in module.variables.names]
    if trained:
        raise InputError(
            f"lens: the run has trained {', '.join(trained)}; allowed: parameters that it has not"
        )
    if module.variables.dependents or module.variables.best_focus:
        raise InputError(
            "lens: some of the run's variables follow by a solve, and would follow the changed "
            "lens too; such a lens cannot be set to other values"
        )
    found = {name: value for name, value in state.items() if not name.startswith(_PREFIX)}
    for name, value in own.items():
        kept = name not in changed and f"{_PREFIX}{name}" in state
        found[f"{_PREFIX}{name}"] = state[f"{_PREFIX}{name}"] if kept else value
    return found


def _same(value: Any, other: Any) -> bool:
    return value.shape == other.shape and bool(torch.equal(value, other))
