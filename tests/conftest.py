import copy
import gc
import json
import logging
import os
import random
import sys
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import numpy
import pytest
import torch
import yaml

from dolens import Lens, load_lens
from dolens.files import user_cache_folder
from dolens.prescriptions import lens_from_prescription
from tests.browser import chromium, page, run_async
from tests.call_stack import run_with_room

__all__ = ["chromium", "page", "run_async"]

ROOT = Path(__file__).resolve().parents[1]
# One thread in each of pytest-xdist's processes, two where there is only one process.
torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else min(2, os.cpu_count() or 1))
# Tests give commands homes of their own: each would compile all kernels again, for seconds.
os.environ.setdefault("NUMBA_CACHE_DIR", str(user_cache_folder()))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Those of whole commands and documents first: none of them is left over at the end, when one
    process would wait for the other.
    """
    first = ROOT / "tests", ROOT / "tests/scripts", ROOT / "tests/cli"
    items.sort(key=lambda item: item.path.parent not in first)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    return run_with_room(item, nextitem)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """The garbage collector never looks at the modules and tests, which stay to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(autouse=True)
def seeded():
    """A test draws the same numbers alone and behind any other in its process."""
    random.seed(0)
    numpy.random.seed(0)
    # For a GPU that nothing has used yet, torch.manual_seed writes down the whole call stack.
    gpu = torch.cuda.is_available()
    (torch.manual_seed if gpu else torch.default_generator.manual_seed)(0)


@pytest.fixture
def one_thread():
    """Small tensors are slower on several: threads wait for each other more than they work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def reference():
    """Reader of the golden data in tests/reference (see its README for where it comes from)."""

    def read(name: str) -> dict:
        return json.loads((ROOT / "tests" / "reference" / name).read_text())

    return read


@pytest.fixture(params=["reference", "cpu"])
def backend(request, monkeypatch):
    """What traces a lens that leaves the choice open; tests that use it state no physics twice."""
    of_lens = Lens.system

    def system(lens, values=None):
        found = of_lens(lens, values)
        return found.traced_by(request.param) if found.backend == "auto" else found

    monkeypatch.setattr(Lens, "system", system)
    return request.param


@pytest.fixture
def moved():
    """A copy of a lens with numbers added to some of its parameters."""

    def build(lens, errors):
        other = copy.deepcopy(lens)
        with torch.no_grad():
            for name, error in errors.items():
                other.variables([name])[name].add_(error)
        return other

    return build


@pytest.fixture
def wavefront_coding(root: Path, backend: str) -> Callable[..., Lens]:
    """The wavefront-coding lens with a cubic plate of the given strength (mm⁻²)."""

    def build(plate: float = 0.0, dtype: torch.dtype = torch.float64) -> Lens:
        lens = load_lens(root / "conf/lens/wavefront_coding.yaml", dtype=dtype)
        lens.backend = backend
        with torch.no_grad():
            lens.surfaces["5"].x3.fill_(plate)
            lens.surfaces["5"].y3.fill_(plate)
        return lens.requires_grad_(False)

    return build


@pytest.fixture
def triplet(root: Path, backend: str) -> Lens:
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    lens.backend = backend
    return lens


@pytest.fixture
def singlet(root: Path) -> Lens:
    """A single lens whose pose is fitted."""
    prescription = yaml.safe_load((root / "conf/lens/la1509.yaml").read_text())
    prescription["elements"] = {"lens": {"surfaces": [1, 2]}}
    return lens_from_prescription(prescription).double().requires_grad_(False)


@pytest.fixture
def dolens_train(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Run `dolens train` in a folder, and return what it says.

    In this process: another would import PyTorch and Lightning for longer than most runs take.
    """
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig
    from typer.testing import CliRunner

    from dolens.cli.app import app

    log = logging.getLogger()
    handlers, level, modules = log.handlers[:], log.level, {*sys.modules}
    monkeypatch.setattr(sys, "argv", [*sys.argv])
    monkeypatch.setattr(sys, "path", [*sys.path])
    folders = []

    def train(folder: Path, *arguments: str) -> str:
        folders.append(folder)
        monkeypatch.chdir(folder)
        GlobalHydra.instance().clear()
        done = CliRunner().invoke(app, ["train", *arguments])
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        assert done.exit_code == 0, done.output[-3000:]
        return done.output

    yield train
    # What Hydra has set for the runs, and a user's own modules.
    for handler in {*log.handlers} - {*handlers}:
        handler.close()
    log.handlers[:] = handlers
    log.setLevel(level)
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None
    for name in {*sys.modules} - modules:
        file = Path(getattr(sys.modules[name], "__file__", None) or ROOT)
        if not file.is_relative_to(ROOT) and any(file.is_relative_to(f) for f in folders):
            del sys.modules[name]
