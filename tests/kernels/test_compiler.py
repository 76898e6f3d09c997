"""Compiled kernels: said once, kept on disk, and no worse off where they cannot be kept."""

import ast
import enum
import errno
import functools
import importlib
import io
import multiprocessing
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba.core import config

from dolens.kernels.cpu import compiler, kernel_files
from dolens.tasks import listening

PROGRAM = """
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
import torch, dolens
lens = dolens.load_lens("conf/lens/{lens}.yaml", torch.float32, backend="cpu")
rays = dolens.Rays(torch.zeros(5, 3) - 1.0, torch.tensor([0.0, 0.0, 1.0]), 550.0)
with torch.no_grad():
    hit = lens.trace(rays)
from dolens.kernels.cpu import compiler
assert hit.valid.shape == (5,)
print("kernels:", *sorted({{factory.__name__ for factory, _ in compiler._kernels}}))
"""


def tiny(real):
    """A block function that is compiled in no time."""

    def kernel(before, after, cotangents, record, work, codes):
        after[0] = before[0]

    return kernel


def run(root, cache, lens="cooke_triplet"):
    """A new process with this cache directory; what it says."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(lens=lens)],
        cwd=root, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_number_that_kernels_freeze_is_in_a_stamped_file():
    # Another file's number could change, and the kernels on disk would go on with the old one.
    stamped, seen = set(compiler.stamped_sources()), set()
    for path in Path(compiler.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("dolens."):
                module = importlib.import_module(node.module)
                taken = [getattr(module, alias.name, None) for alias in node.names]
                if any(isinstance(one, int | float | enum.EnumMeta) for one in taken):
                    seen.add(Path(module.__file__))
    assert {path.name for path in seen} > {"table.py", "layout.py"}
    assert seen <= stamped


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
    monkeypatch.setattr(kernel_files, "_said", set())
    compiler.compile_block.cache_clear()
    yield monkeypatch
    compiler.compile_block.cache_clear()


def test_a_user_without_a_home_folder_waits_for_the_compiler_again(forget, caplog):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    forget.setattr(kernel_files, "cache_folder", no_home)
    assert compiler.compile_block(tiny, "float32") != 0
    assert "cannot be kept for the next start: Could not determine home" in caplog.text


def test_a_folder_that_cannot_be_written_costs_time_only(forget, caplog, tmp_path):
    """Nor does anything lie beside the sources, where an installation may be read-only."""
    (tmp_path / "file").touch()
    forget.setattr(config, "CACHE_DIR", str(tmp_path / "file"))
    assert compiler.compile_block(tiny, "float32") != 0
    assert "cannot be kept for the next start" in caplog.text


def start_again(monkeypatch):
    """As a new process: nothing is compiled but what is on disk."""
    monkeypatch.setattr(compiler, "_kernels", {})
    compiler.compile_block.cache_clear()


@pytest.fixture
def kept(forget, tmp_path):
    """The file of a compiled kernel."""
    forget.setattr(config, "CACHE_DIR", str(tmp_path))
    compiler.compile_block(tiny, "float32")
    (path,) = tmp_path.rglob("*.kernel")
    return path


def flipped(content, place):
    """The content with one bit the other way."""
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


DAMAGES = {
    "empty": lambda whole: b"",
    "other": lambda whole: b"not a kernel",
    "cut": lambda whole: whole[: len(whole) // 2],
    "one bit of the digest": lambda whole: flipped(whole, 3),
    "one bit of the name": lambda whole: flipped(whole, 40),
    "one bit of the code": lambda whole: flipped(whole, len(whole) // 2),
    "the last bit": lambda whole: flipped(whole, len(whole) - 1),
    "longer": lambda whole: whole + b"0",
}


def test_a_damaged_kernel_is_compiled_anew(kept, forget, caplog, tmp_path):
    whole, compile_once, made = kept.read_bytes(), functools.cache(compiler._made), []
    forget.setattr(compiler, "_made", lambda *what: made.append(what) or compile_once(*what))
    for number, (name, damage) in enumerate(DAMAGES.items(), 1):
        kept.write_bytes(damage(whole))
        caplog.clear()
        start_again(forget)
        assert compiler.compile_block(tiny, "float32") != 0
        assert caplog.text.count("is damaged") == 1 and str(kept) in caplog.text, name
        assert kept.read_bytes() != damage(whole)
        caplog.clear()
        start_again(forget)
        assert compiler.compile_block(tiny, "float32") != 0 and not caplog.text
        assert len(made) == number
    assert list(tmp_path.rglob("*.*")) == [kept]  # and no temporary file is left


def test_a_kernel_in_the_place_of_another_is_compiled_anew(kept, forget, caplog, tmp_path):
    compiler.compile_block(tiny, "float64")
    (other,) = set(tmp_path.rglob("*.kernel")) - {kept}
    other.write_bytes(kept.read_bytes())
    start_again(forget)
    assert compiler.compile_block(tiny, "float64") != compiler.compile_block(tiny, "float32")
    assert caplog.text.count("is damaged") == 1 and str(other) in caplog.text


def test_machine_code_that_cannot_be_loaded_is_compiled_anew(kept, forget, caplog):
    forget.setattr(kernel_files, "load", lambda kernel: (_ for _ in ()).throw(RuntimeError("no")))
    start_again(forget)
    assert compiler.compile_block(tiny, "float32") != 0
    assert "made anew: no" in caplog.text


def test_a_kernel_on_disk_holds_no_python_objects(kept, forget):
    """Numba's own cache is a pickle, which can run whatever it likes."""
    forget.setattr(pickle, "loads", lambda *_: pytest.fail("unpickled"))
    forget.setattr(pickle, "Unpickler", lambda *_: pytest.fail("unpickled"))
    forget.setattr(compiler, "_made", lambda *_: pytest.fail("compiled"))
    start_again(forget)
    assert compiler.compile_block(tiny, "float32") != 0


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a system without owners of files")
def test_a_kernel_that_others_may_have_written_is_not_used(kept, forget, caplog):
    assert not kept.stat().st_mode & 0o077 and not kept.parent.stat().st_mode & 0o077
    for mode in (0o620, 0o602):
        kept.chmod(mode)
        caplog.clear()
        start_again(forget)
        assert compiler.compile_block(tiny, "float32") != 0
        assert "others may have written it" in caplog.text
        assert not kept.stat().st_mode & 0o077  # it is a new one
    for owner, private in ((os.geteuid(), True), (0, True), (os.geteuid() + 1, False)):
        status = SimpleNamespace(st_uid=owner, st_mode=0o100600)
        assert kernel_files.is_private(status) is private


def test_a_folder_in_the_place_of_a_kernel_costs_time_only(kept, forget, caplog):
    kept.unlink()
    kept.mkdir()
    start_again(forget)
    assert compiler.compile_block(tiny, "float32") != 0
    assert "cannot be read" in caplog.text and "cannot be kept" in caplog.text
    assert os.listdir(kept.parent) == [kept.name]


def test_a_full_disk_leaves_no_part_of_a_kernel_and_is_said_once(forget, caplog, tmp_path):
    class Full(io.BytesIO):
        def write(self, content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    forget.setattr(config, "CACHE_DIR", str(tmp_path))
    opened = os.fdopen
    forget.setattr(os, "fdopen", lambda handle, mode: os.close(handle) or Full())
    for real in ("float32", "float64"):
        assert compiler.compile_block(tiny, real) != 0
    forget.setattr(os, "fdopen", opened)
    assert caplog.text.count("No space left") == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def _compile_at_once(cache, together, queue):
    config.CACHE_DIR = cache
    compiler._kernels.clear()
    compiler.compile_block.cache_clear()
    together.wait(60)
    queue.put(compiler.compile_block(tiny, "float32") != 0)


def test_two_processes_that_compile_at_once_leave_one_good_kernel(forget, caplog, tmp_path):
    context = multiprocessing.get_context("fork")
    together, queue = context.Barrier(2), context.Queue()
    arguments = (str(tmp_path), together, queue)
    children = [context.Process(target=_compile_at_once, args=arguments) for _ in range(2)]
    for child in children:
        child.start()
    assert queue.get(timeout=120) and queue.get(timeout=120)
    for child in children:
        child.join(60)
        assert child.exitcode == 0
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1
    forget.setattr(config, "CACHE_DIR", str(tmp_path))
    forget.setattr(compiler, "_made", lambda *_: pytest.fail("compiled"))
    assert compiler.compile_block(tiny, "float32") != 0 and not caplog.text


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
        target = ("x86_64", "some-cpu", features)
        return kernel_files.KernelFiles("clip", "0" * 64, source, target).path

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
            compiler.compile_block(tiny, "float32")
    # Not when the kernel is read from disk.
    name = ("compiling kernels: tiny",)
    assert heard == [(name, True), (name, False)]
