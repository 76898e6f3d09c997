"""The settings that a run reads, as one typed object, and the objectives that it returns."""

import logging
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf

from dolens.errors import InputError, check_choice, check_count, did_you_mean
from dolens.prescriptions.cells import with_tables
from dolens.typed_values import check_type, parameters_of

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


DTYPES = {"float32": torch.float32, "float64": torch.float64}
# Of NumPy's generators.
_SEEDS = 2**32
_PRECISIONS = ("highest", "high", "medium")
# Whose types are compared with the hints; others have checks of their own.
_TYPED = (
    *("module", "data", "trainer", "callbacks", "logger", "lens"),
    *("train", "test", "seed", "ckpt_path", "state", "live"),
)


@dataclass(frozen=True)
class RunSettings:
    """The top-level keys of a configuration that a run reads; one field each.

    A run reads nothing else: any other key must be referred to by one of these, or it is an error
    (see `refuse_unread`).  A new key of a run is a new field.

    Attributes:
        lens: the prescription; None: the module makes a lens of its own.
        module: makes the `Experiment` from its lens.
        data: makes the data module.
        trainer: makes the trainer.
        callbacks: name → what makes a callback, or None.
        logger: name → what makes a logger, or None.
        extensions: names of Python modules that are imported first, as they register surfaces.
        seed: the seed of all random numbers.
        backend: what traces rays; see `dolens.load_lens`.
        lens_dtype: `float32` or `float64`.
        threads: torch's threads; None leaves torch's own choice.
        matmul_precision: `highest`, `high` or `medium`.
        train: whether to train.
        test: whether to test.
        ckpt_path: a checkpoint to resume from, or None.
        objective: the name of the metric that the run returns, or a list of them.
        state: of a lens that zooms or focuses, the state to work with; None: the lens itself.
        live: whether a page shows the run; see `dolens watch`.

    Raises:
        InputError: a value that is not allowed.
    """

    module: DictConfig
    data: DictConfig
    trainer: DictConfig
    callbacks: DictConfig | None
    logger: DictConfig | None
    extensions: ListConfig | None
    seed: int
    backend: str
    lens_dtype: str
    threads: int | None
    matmul_precision: str
    train: bool
    test: bool
    ckpt_path: str | None
    objective: str | ListConfig
    lens: DictConfig | None = None
    # Run folders of old lack them.
    state: str | None = None
    live: bool = False

    def __post_init__(self) -> None:
        hints = parameters_of(type(self)).hints
        for key in _TYPED:
            check_type(getattr(self, key), hints[key], key)
        check_choice(self.lens_dtype, DTYPES, "lens_dtype")
        check_choice(self.matmul_precision, _PRECISIONS, "matmul_precision")
        if not 0 <= self.seed < _SEEDS:
            raise InputError(f"seed: {self.seed}; allowed: an integer from 0 to {_SEEDS - 1}")
        if self.threads is not None:
            check_count("threads", self.threads)
        check_trainer(self.trainer)
        for name in self.objectives:
            if name.startswith("test/") and not self.test:
                raise InputError(f"objective: '{name}' needs test=true, or name another metric")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the keys that a run reads."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def of(cls, cfg: DictConfig) -> "RunSettings":
        """Read them from a composed configuration.

        Raises:
            InputError: a key is missing, or a value is not allowed.
        """
        needed = [field.name for field in fields(cls) if field.default is MISSING]
        missing = [name for name in needed if name not in cfg]
        if missing:
            raise InputError(f"{missing[0]}: is missing from the configuration")
        return cls(**{name: cfg[name] for name in cls.names() if name in cfg})

    @property
    def objectives(self) -> tuple[str, ...]:
        """Return the names of the metrics that the run returns."""
        return objective_names(self.objective)

    @property
    def dtype(self) -> torch.dtype:
        """The lens's precision."""
        return DTYPES[self.lens_dtype]

    def prescription(self) -> dict[str, Any]:
        """Return the lens as plain data, with the tables of cells that it names as files.

        Raises:
            InputError: there is none, as in a search for lenses, which makes its own; or a table
                cannot be read.
        """
        if self.lens is None:
            raise InputError("lens: is missing from the configuration")
        return with_tables(OmegaConf.to_container(self.lens, resolve=True))


# The least that each may be; -1 of some means all, or no end.
_LEAST = {
    "max_epochs": -1,
    "check_val_every_n_epoch": 1,
    "log_every_n_steps": 0,
    "num_sanity_val_steps": -1,
}


def check_trainer(settings: Mapping[str, Any]) -> None:
    """Refuse counts that a trainer cannot work with.

    Args:
        settings: of `lightning.Trainer`; what is not there or null is Lightning's own.

    Raises:
        InputError: the first that is no integer, or too small.
    """
    for key, least in _LEAST.items():
        if settings.get(key) is not None:
            check_count(f"trainer.{key}", settings[key], least)
