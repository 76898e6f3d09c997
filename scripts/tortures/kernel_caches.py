"""Compiled kernels on disk that two processes make at once, or that something has happened to."""

from pathlib import Path

from scripts.tortures.ends import line_of, log
from scripts.tortures.kinds import KINDS
from scripts.tortures.processes import Process, start, trust
from scripts.tortures.run_folders import differences, faults_of

RUN = [*KINDS["design, least squares"], "trainer.max_epochs=1"]


def started(folder: Path, name: str) -> Process:
    """Start a run whose compiled kernels lie in `folder/cache` alone."""

    def prepare() -> None:
        trust()
        from numba.core import config

        config.CACHE_DIR = str(folder / "cache")

    return start([*RUN, f"hydra.run.dir={folder / name}"], log(folder / "x"), prepare)


def kernels_of(folder: Path) -> list[Path]:
    """Return the files of compiled kernels."""
    return sorted((folder / "cache").rglob("*.kernel"))


def compiled_at_once(folder: Path) -> list[str]:
    """Let two runs compile the same kernels for the first time, at the same time."""
    both = [started(folder, name) for name in ("one", "other")]
    if any([process.wait(600.0) for process in both]):
        return [line_of(process) for process in both]
    wrong = differences(folder / "one", folder / "other")
    wrong += [fault for name in ("one", "other") for fault in faults_of(folder / name)]
    left = {p for p in (folder / "cache").rglob("*") if p.is_file()} - {*kernels_of(folder)}
    wrong += [f"left: {path}" for path in left]
    for process in both:
        if "compiling kernels" not in process.said():
            wrong.append("a run did not compile")
    return wrong + _silent(folder, "third")


def damaged_kernels(folder: Path) -> list[str]:
    """Flip a byte of one compiled kernel and cut another short: they are made anew, and once."""
    process = started(folder, "one")
    if process.wait(600.0):
        return [line_of(process)]
    kernels = kernels_of(folder)
    if len(kernels) < 2:
        return [f"{len(kernels)} kernels: too few to damage"]
    whole = {path: path.read_bytes() for path in kernels}
    first, last = kernels[0], kernels[-1]
    place = len(whole[first]) // 2
    byte = bytes([whole[first][place] ^ 255])
    first.write_bytes(whole[first][:place] + byte + whole[first][place + 1 :])
    last.write_bytes(whole[last][: len(whole[last]) // 2])
    process = started(folder, "again")
    if process.wait(600.0):
        return [line_of(process)]
    wrong = []
    for path in kernels:
        lines = [line for line in process.said().splitlines() if str(path) in line]
        if len(lines) != (path in (first, last)) or not all("damaged" in line for line in lines):
            wrong.append(f"{path.name}: {len(lines)} lines")
    if kernels_of(folder) != kernels:
        wrong.append("other files of kernels")
    return [*wrong, *differences(folder / "one", folder / "again"), *_silent(folder, "third")]


def _silent(folder: Path, name: str) -> list[str]:
    """Start once more: nothing is compiled, nothing is said of it, and all is the same."""
    process = started(folder, name)
    if process.wait(600.0):
        return [line_of(process)]
    told = ("compiling kernels", "compiled kernel")
    lines = [line for line in process.said().splitlines() if any(words in line for words in told)]
    return [f"said: {line[:200]}" for line in lines] + differences(folder / "one", folder / name)
