"""The metrics that a run returns: one, or several for a search with several objectives."""

import logging
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from omegaconf import ListConfig

from dolens.errors import InputError, did_you_mean

logger = logging.getLogger(__name__)

_COSTS = ("cost/wall_s", "cost/step_s", "cost/rays", "cost/peak_memory_mb", "cost/*")
# Parts of these packages log nothing but what `Experiment.metric_names` names.
_KNOWN = ("dolens.", "torch.", "lightning.pytorch.callbacks.ModelCheckpoint")


def objective_names(objective: Any) -> tuple[str, ...]:
    """Return the names of the objectives.

    Args:
        objective: the setting: a name, or a list of names.

    Raises:
        InputError: something else, an empty list, or a name twice.
    """
    names = tuple(objective) if isinstance(objective, list | tuple | ListConfig) else (objective,)
    if not names or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"objective: {objective!r}; allowed: the name of a metric, or a list of them"
        )
    if len(set(names)) < len(names):
        raise InputError(f"objective: {', '.join(names)}: a name stands twice")
    return names


def refuse_unknown(
    names: Sequence[str], known: Collection[str] | None, parts: Iterable[str]
) -> None:
    """Refuse objectives that a run will not have, before any work is done for them.

    Args:
        names: of the objectives.
        known: what `Experiment.metric_names` returns; None: nothing is known yet.
        parts: what the run is made of, as `torch.optim.Adam`; where some are of a user's own, they
            may log what nobody knows, and an unknown name is a warning.

    Raises:
        InputError: an objective that there will not be; the message has names that are near.
    """
    if known is None:
        return
    known = [*known, *_COSTS]
    own = [part for part in parts if not part.startswith(_KNOWN)]
    for name in names:
        if is_among(name, known):
            continue
        if not own:
            raise no_metric(name, known)
        logger.warning("%s, unless %s logs it", no_metric(name, known), " or ".join(own))


def is_among(name: str, known: Collection[str]) -> bool:
    """Return whether a metric is one of some names, in which `*` stands for anything."""
    return any(
        re.fullmatch(".*".join(map(re.escape, pattern.split("*"))), name) for pattern in known
    )


def no_metric(name: str, known: Collection[str]) -> InputError:
    """Return the error of an objective that is none of the known metrics; it names those of the
    same kind, or all kinds that there are.
    """
    kind = name.partition("/")[0]
    plain = [one for one in known if "*" not in one]
    found = [one for one in known if one.startswith(f"{kind}/")]
    kinds = [one.partition("/")[0] for one in known]
    found = found or [f"{one}/..." for one in dict.fromkeys(kinds) if "*" not in one]
    return InputError(
        f"objective: '{name}' is no metric of this run{did_you_mean(name, plain)} "
        f"(there are: {', '.join(found) or 'none'})"
    )


def returned(names: Sequence[str], numbers: Mapping[str, float]) -> float | tuple[float, ...]:
    """Return the objectives of a finished run: a number, or as many as there are names.

    Raises:
        InputError: the run has no such metric.
    """
    for name in names:
        if name not in numbers:
            raise no_metric(name, numbers)
    values = tuple(numbers[name] for name in names)
    return values if len(values) > 1 else values[0]
