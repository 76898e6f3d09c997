"""Compiled kernels: said once, kept on disk, and no worse off where they cannot be kept."""

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from numba.core import config

from dolens.kernels.cpu import compiler, kernel_files
from dolens.kernels.cpu.plane import clip
from dolens.stages import listening

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


def test_a_user_without_a_home_folder_waits_for_the_compiler_again(forget, caplog):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    forget.setattr(kernel_files, "cache_folder", no_home)
    assert compiler.compile_block(clip, "float32") != 0
    assert "cannot be kept for the next start: Could not determine home" in caplog.text


def test_a_folder_that_cannot_be_written_costs_time_only(forget, caplog, tmp_path):
    """Nor does anything lie beside the sources, where an installation may be read-only."""
    (tmp_path / "file").touch()
    forget.setattr(config, "CACHE_DIR", str(tmp_path / "file"))
    assert compiler.compile_block(clip, "float32") != 0
    assert "cannot be kept for the next start" in caplog.text


@pytest.mark.parametrize("damage", [b"", b"not a kernel", None], ids=["empty", "other", "cut"])
def test_a_damaged_kernel_is_compiled_anew(forget, caplog, tmp_path, damage):
    forget.setattr(config, "CACHE_DIR", str(tmp_path))
    compiler.compile_block(clip, "float32")
    (kept,) = tmp_path.rglob("*.kernel")
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    forget.setattr(compiler, "_kernels", {})
    compiler.compile_block.cache_clear()
    assert compiler.compile_block(clip, "float32") != 0
    assert "damaged" in caplog.text
    assert kept.stat().st_size > len(whole) // 2
    assert list(tmp_path.rglob("*.kernel")) == [kept]  # and no temporary file is left
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1


def test_kernels_lie_in_the_users_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert kernel_files.cache_folder() == tmp_path / "dolens" / "kernels"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for not_absolute in ("", "here"):
        monkeypatch.setenv("XDG_CACHE_HOME", not_absolute)
        assert kernel_files.cache_folder() == tmp_path / "home/.cache/dolens/kernels"
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "numba"))
    assert kernel_files.cache_folder() == tmp_path / "numba" / "dolens"


def test_another_processor_and_another_source_have_other_files(forget, tmp_path):
    """So machines that share a home folder never run each other's instructions."""

    def path(source=("module", "name"), features="+avx2"):
        codegen = SimpleNamespace(magic_tuple=lambda: ("x86_64", "some-cpu", features))
        return kernel_files.KernelFiles("clip", "0" * 64, source).path(codegen)

    forget.setattr(config, "CACHE_DIR", str(tmp_path))
    assert path() == path()
    assert len({path(), path(features="+avx2,+avx512f"), path(source=("module", "other"))}) == 3


def test_kernels_of_versions_that_are_long_gone_are_deleted(tmp_path):
    now = time.time()
    for name, days in (("used", 1.0), ("forgotten", 400.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "clip.kernel").touch()
        os.utime(tmp_path / name, (now - 86400.0 * days,) * 2)
    kernel_files.delete_old(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["used"]


def test_compiling_is_a_stage(forget, tmp_path):
    """A program around the library can say why it waits."""
    forget.setattr(config, "CACHE_DIR", str(tmp_path))
    heard = []
    for _ in range(2):
        compiler._kernels.clear()
        compiler.compile_block.cache_clear()
        with listening(heard.append):
            compiler.compile_block(clip, "float32")
    # Not when the kernel is read from disk.
    name = ("compiling kernels: clip",)
    assert heard == [(name, True), (name, False)]
