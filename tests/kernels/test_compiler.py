"""Compiled kernels: said once, kept on disk, and no worse off where they cannot be kept."""

import os
import subprocess
import sys

import pytest
from numba.core import config
from numba.core.caching import FunctionCache

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.plane import clip

PROGRAM = """
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
import torch, dolens
lens = dolens.load_lens("conf/lens/{lens}.yaml", torch.float32, backend="cpu")
rays = dolens.Rays(torch.zeros(5, 3) - 1.0, torch.tensor([0.0, 0.0, 1.0]), 550.0)
lens.trace(rays).position.sum().backward()
hit = lens.trace(rays)
from dolens.kernels.cpu import compiler
assert hit.valid.shape == (5,)
print("kernels:", *sorted({{factory.__name__ for factory, _ in compiler._kernels}}))
"""


def run(root, cache, lens="cooke_triplet"):
    """A new process with this cache directory; what it says."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(lens=lens)],
        cwd=root, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_first_start_compiles_and_the_second_reads(root, tmp_path):
    first, second = run(root, tmp_path), run(root, tmp_path)
    assert first.count("compiling kernels") == 1
    assert "compiling kernels" not in second
    # Of the kinds of surface, those that the lens has, and no other.
    kernels = first[first.index("kernels: ") :]
    for kind in ("sphere", "sensor"):
        assert f"{kind}_forward" in kernels
    for kind in (
        "plane_forward",
        "conic",
        "explicit",
        "even_asphere",
        "xy_polynomial",
        "b_spline",
        "change_axes",
    ):
        assert kind not in kernels


@pytest.fixture
def forget(monkeypatch):
    """This process has compiled nothing yet, and keeps nothing of this test."""
    monkeypatch.setattr(compiler, "_kernels", {})
    compiler.compile_block.cache_clear()
    yield monkeypatch
    compiler.compile_block.cache_clear()


def test_a_cache_without_a_place_costs_time_only(forget, caplog):
    """Neither beside the sources nor in the user's own directory."""

    def no_place(self, function):
        raise RuntimeError("no locator available")

    forget.setattr(FunctionCache, "__init__", no_place)
    assert compiler.compile_block(clip, "float32") != 0
    assert "cannot be kept for the next start: no locator available" in caplog.text


def test_a_full_disk_costs_time_only(forget, caplog):
    def full(self, sig, data):
        raise OSError(28, "No space left on device")

    forget.setattr(compiler._StampedCache, "load_overload", lambda self, sig, context: None)
    forget.setattr(FunctionCache, "save_overload", full)
    assert compiler.compile_block(clip, "float32") != 0
    assert "No space left on device" in caplog.text


def test_a_damaged_cache_is_compiled_anew(forget, caplog, tmp_path):
    forget.setattr(config, "CACHE_DIR", str(tmp_path))
    compiler.compile_block(clip, "float32")
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(b"")
    forget.setattr(compiler, "_kernels", {})
    compiler.compile_block.cache_clear()
    assert compiler.compile_block(clip, "float32") != 0
    assert "damaged" in caplog.text
    assert index.stat().st_size > 0
