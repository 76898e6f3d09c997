"""The settings that a run reads, as one typed object."""

from dataclasses import MISSING, dataclass, fields
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf

from dolens.errors import InputError, check_choice
from dolens.experiments.checks import check_count
from dolens.experiments.running.objectives import objective_names
from dolens.experiments.running.trainer_settings import check_trainer

DTYPES = {"float32": torch.float32, "float64": torch.float64}
# Of NumPy's generators.
_SEEDS = 2**32
_PRECISIONS = ("highest", "high", "medium")


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
    # Run folders of old lack it.
    state: str | None = None

    def __post_init__(self) -> None:
        for key in ("module", "data", "trainer"):
            _check_mapping(key, getattr(self, key))
        for key in ("callbacks", "logger", "lens"):
            if getattr(self, key) is not None:
                _check_mapping(key, getattr(self, key))
        check_choice(self.lens_dtype, DTYPES, "lens_dtype")
        check_choice(self.matmul_precision, _PRECISIONS, "matmul_precision")
        for key in ("train", "test"):
            _check_type(key, getattr(self, key), bool, "true or false")
        _check_type("seed", self.seed, int, "an integer")
        if not 0 <= self.seed < _SEEDS:
            raise InputError(f"seed: {self.seed}; allowed: an integer from 0 to {_SEEDS - 1}")
        for key in ("ckpt_path", "state"):
            if getattr(self, key) is not None:
                _check_type(key, getattr(self, key), str, "a text, or null")
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
        """Return the lens as plain data.

        Raises:
            InputError: there is none, as in a search for lenses, which makes its own.
        """
        if self.lens is None:
            raise InputError("lens: is missing from the configuration")
        return OmegaConf.to_container(self.lens, resolve=True)


def _check_mapping(key: str, value: Any) -> None:
    if not isinstance(value, DictConfig):
        raise InputError(f"{key}: {value!r}; allowed: settings, as a mapping")


def _check_type(key: str, value: Any, kind: type, allowed: str) -> None:
    # A bool is an int to Python, and none to a user.
    if type(value) is not kind:
        raise InputError(f"{key}: {value!r}; allowed: {allowed}")
