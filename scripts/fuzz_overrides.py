"""Wrong values are given to every setting of every experiment: each is one clear line.

python scripts/fuzz_overrides.py --overrides 1000

A run is made up to its first step.  What is taken without a word is listed, to be judged: a huge
number may be allowed, a negative count is not.
"""

import argparse
import contextlib
import copy
import logging
import random
import sys
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from lightning.pytorch.loops.evaluation_loop import _EvaluationLoop
from lightning.pytorch.loops.fit_loop import _FitLoop
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.errors import InputError, one_line
from dolens.experiments.running.main import machine_fault, reason_of
from dolens.experiments.running.run_files import flat
from dolens.experiments.running.training import run
from scripts.guarded_cases import guarded, place_of, unclear
from tests.experiments.conftest import composing

ROOT = Path(__file__).resolve().parents[1]
_NUMBERS = ("abc", "-1", "0", "nan", "inf", "-inf", "1e300", "''", "null", "[]", "[1,2]", "true",
            "{a:1}", "-1e-3", "1.5", "1000000000000")  # fmt: skip
_TEXTS = ("''", "foo", "3", "-1.5", "null", "[]", "true", "{a:1}")
_TRUTHS = ("foo", "2", "null", "[]", "1.5", "''")
_LISTS = ("[]", "foo", "3", "null", "[[]]", "[abc]", "[nan]", "[-1]", "{a:1}", "[0]", "[inf]")
# Where files are written, and what is looked at by itself (`--lens`).
_LEFT = ("hydra", "lens", "_target_", "_partial_", "_convert_", "trainer.default_root_dir",
         "callbacks", "logger")  # fmt: skip


class Reached(BaseException):
    """A run came as far as its first step."""


def main() -> int:
    """Print the table; the exit status is 1 where a run ended in a traceback."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--overrides", type=int, default=1000, help="how many runs are tried")
    parser.add_argument("--first", type=int, default=0, help="the seed of their order")
    parser.add_argument("--skip", type=int, default=0, help="so many of this order, tried before")
    parser.add_argument("--experiment", action="append", help="this one alone")
    parser.add_argument("--override", action="append", help="this one alone, of each experiment")
    parser.add_argument("--lens", action="store_true", help="settings of the lens, and no others")
    parser.add_argument("--key", default="", help="settings whose names begin so")
    parser.add_argument("--seconds", type=float, default=60.0, help="of processor time for a run")
    options = parser.parse_args()
    names = options.experiment or sorted(p.stem for p in (ROOT / "conf" / "experiment").iterdir())
    logging.disable()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        cases = [(name, one) for name in names for one in options.override or ()]
        cases = cases or _cases(names, options.key, options.lens, Path(folder))
        random.Random(options.first).shuffle(cases)
        # The same override of another experiment comes when all others were tried.
        tried: Counter[str] = Counter()
        turns = []
        for case in cases:
            turns.append(tried[case[1]])
            tried[case[1]] += 1
        cases = [cases[n] for n in sorted(range(len(cases)), key=lambda number: turns[number])]
        # Those of one experiment follow each other: it is composed once.
        cases = sorted(cases[options.skip :][: options.overrides])
        begin, found, kept = time.monotonic(), Counter(), defaultdict(list)

        def check(number: int) -> str:
            experiment, override = cases[number]
            return outcome(Path(folder), experiment, override)

        for number, answer in guarded(check, range(len(cases)), options.seconds, 4096):
            said, _, detail = answer.partition("\0")
            found[said] += 1
            kept[said].append(" ".join(cases[number]))
            if not said.startswith("one line"):
                print(f"{said}: {' '.join(cases[number])}: {detail}", flush=True)
    print(f"{len(cases)} overrides in {time.monotonic() - begin:.0f} s")
    for said, count in sorted(found.items()):
        print(f"{count:7d}  {said}")
    return int(any(not said.startswith(("one line", "taken")) for said in found))


def outcome(folder: Path, experiment: str, *overrides: str) -> str:
    """Return what comes of a run up to its first epoch: `one line` or `taken` where all is well."""
    stop = patch.object(_FitLoop, "on_advance_start", side_effect=Reached)
    idle = patch.object(_EvaluationLoop, "_evaluation_step", side_effect=Reached)
    cfg = _changed(folder, experiment, overrides)
    try:
        with _settings_of_torch(), stop, idle:
            run(cfg)
        return "taken"
    except Reached:
        return "taken"
    except (SystemExit, Exception) as error:
        return _judged(error, cfg, overrides)


def _changed(folder: Path, experiment: str, overrides: tuple[str, ...]) -> DictConfig:
    """Return an experiment's configuration with some values changed."""
    cfg = copy.deepcopy(_composed(folder, experiment))
    OmegaConf.set_readonly(cfg.hydra, False)
    for override in overrides:
        key, _, text = override.partition("=")
        (parsed,) = OverridesParser.create().parse_overrides([f"value={text}"])
        if _put(cfg, key.lstrip("+"), parsed.value()):
            # As it would be typed: a setting that nothing reads is named by it.
            cfg.hydra.overrides.task = [*cfg.hydra.overrides.task, override]
    HydraConfig.instance().set_config(cfg)
    return cfg


def _put(node: DictConfig, key: str, value: Any) -> bool:
    """Set a value; return whether the grammar of overrides can name it.

    Names of parameters have dots and stars in them, and are set with the mapping around them.
    """
    found = [name for name in node if key == name or key.startswith(f"{name}.")]
    name = max(found, key=len, default=key)
    if len(name) < len(key):
        inside = _put(node[name], key[len(name) + 1 :], value)
        return inside and "." not in name
    with open_dict(node):
        node[name] = value
    return "." not in name


@cache
def _composed(folder: Path, experiment: str) -> DictConfig:
    # The published settings need the paper's photographs, and weights that are to be downloaded.
    more = []
    if experiment.endswith("_paper"):
        for number in range(12):
            Image.new("RGB", (64, 64)).save(folder / f"{number}.png")
        more = [f"data.root={folder}", "loss.perceptual=none"]
    if experiment == "large_fov_doublet_paper":
        more.append("network.weights=none")
    with composing(ROOT, folder) as build:
        return build(f"experiment={experiment}", *more)


def _judged(error: BaseException, cfg: DictConfig, overrides: tuple[str, ...]) -> str:
    """Return whether an error is one line that names the setting, as `main` would print it."""
    if machine_fault(error) is not None:
        return "one line of the machine\0" + machine_fault(error)
    if not isinstance(error, InputError | HydraException | OmegaConfBaseException):
        return f"{type(error).__name__} at {place_of(error)}\0{one_line(error)[:300]}"
    message = reason_of(error, cfg)
    if said := unclear(message):
        return f"{said}\0{message[:300]!a}"
    key = overrides[-1].partition("=")[0].lstrip("+~")
    last = key.rpartition(".")[2]
    if last not in message and key.split(".")[0] not in message:
        return f"message does not name the setting\0{message[:300]}"
    return "one line"


@contextlib.contextmanager
def _settings_of_torch() -> Iterator[None]:
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(precision)


def _cases(names: list[str], begin: str, lens: bool, folder: Path) -> list[tuple[str, str]]:
    """Return every experiment with every wrong value of each of its settings, or of its lens's."""
    found = []
    for name in names:
        plain = OmegaConf.to_container(_composed(folder, name), resolve=False)
        for key, value in flat(plain["lens"], "lens") if lens else _leaves(plain):
            if key.startswith(begin):
                found += [(name, f"{key}={wrong}") for wrong in _wrong(value)]
    return found


def _leaves(plain: Any) -> Iterator[tuple[str, Any]]:
    for key, value in flat(plain):
        if any(part in _LEFT for part in (key, key.split(".")[0], key.rpartition(".")[2])):
            continue
        if isinstance(value, str) and "${" in value:
            continue
        if not any(part.isdecimal() for part in key.split(".")):
            yield key, value


def _wrong(value: Any) -> tuple[str, ...]:
    if isinstance(value, bool):
        return _TRUTHS
    if isinstance(value, int | float):
        return _NUMBERS
    return _LISTS if isinstance(value, list) else _TEXTS


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
