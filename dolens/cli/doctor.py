"""The command `dolens doctor`: what this machine has, and what is missing for what."""

import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

# An extra → what needs its packages.
EXTRAS = {
    "train": "dolens train, evaluate, apply of a run, compare, report",
    "sweep": "sweeps on all cores: -m hydra/launcher=joblib",
    "slurm": "sweeps on a cluster: -m hydra/launcher=submitit_slurm",
    "ray": "workers=2, -m hydra/launcher=ray",
    "search": "-m search=optuna",
    "cad": "STEP files by dolens export",
    "onnx": "ONNX files by dolens export",
    "edges": "loss.perceptual=vgg16_edges",
    "bm3d": "network=wiener_bm3d; not for commercial use",
    "spectra": "experiment=snapshot_spectra",
    "mlflow": "logger=mlflow",
    "wandb": "logger=wandb",
    "live": "dolens play, dolens watch, train live=true",
    "mcp": "dolens mcp",
    "docs": "the documentation site and its notebooks",
}


class Finding(NamedTuple):
    """A row of the page: what was looked for, what was found, and whether anything is missing."""

    what: str
    found: str
    well: bool = True


def doctor() -> None:
    """Say what this machine has for dolens, and what is missing for what.  It changes nothing.

    Example: dolens doctor
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from dolens.errors import readable

    console = Console(highlight=False)
    for title, findings in (
        ("Machine", [*_machine(), *_graphics()]),
        ("Kernels", [*_kernels(), _trace()]),
        ("Extras", [*_extras()]),
        ("Files", [*_photographs(), _fonts(), _completion()]),
    ):
        console.print(f"\n{title}", style="bold cyan")
        table = Table.grid(padding=(0, 2), pad_edge=True)
        for name in ("mark", "what"):
            table.add_column(name, no_wrap=True)
        table.add_column("found", overflow="fold")
        for row in findings:
            mark = Text("✓", "green") if row.well else Text("–", "yellow")
            table.add_row(mark, Text(row.what, "bold"), Text(readable(row.found)))
        console.print(table)


def _machine() -> Iterator[Finding]:
    from dolens.files import installed_version
    from dolens.threads import COUNTS, allowed_processors

    yield Finding("dolens", f"{installed_version('dolens')}, {Path(__file__).parents[1]}")
    yield Finding("Python", f"{platform.python_version()}, {platform.platform()}")
    packages = ("torch", "numpy", "numba")
    yield Finding("Packages", ", ".join(f"{name} {installed_version(name)}" for name in packages))
    given = [f"{name}={os.environ[name]}" for name in COUNTS if name in os.environ]
    yield Finding(
        "Processors",
        f"{allowed_processors()} of {os.cpu_count()}"
        + (f"; threads as {' and '.join(given)} say" if given else ""),
    )
    if sys.dont_write_bytecode:
        yield Finding(
            "Bytecode",
            "not kept (PYTHONDONTWRITEBYTECODE): each process compiles all that it imports, "
            "a second or more",
            False,
        )


def _graphics() -> Iterator[Finding]:
    import torch

    from dolens.files import installed_version

    if not torch.cuda.is_available():
        built = torch.version.cuda
        yield Finding(
            "GPU",
            "none found; nothing needs one"
            + ("" if built else "; this PyTorch is built without CUDA"),
        )
        return
    for number in range(torch.cuda.device_count()):
        of_card = torch.cuda.get_device_properties(number)
        yield Finding("GPU", f"{of_card.name}, {of_card.total_memory / 2**30:.0f} GiB")
    triton = installed_version("triton")
    yield Finding("Triton", triton or "not installed: no kernels on the GPU", bool(triton))


def _kernels() -> Iterator[Finding]:
    from dolens.kernels.cpu.kernel_files import cache_folder

    try:
        folder = cache_folder()
    except RuntimeError as error:
        yield Finding("Cache", f"{error}: each process compiles its kernels anew", False)
        return
    files = list(folder.glob("**/*.kernel"))
    size = sum(file.stat().st_size for file in files)
    nearest = next(parent for parent in (folder, *folder.parents) if parent.exists())
    writable = os.access(nearest, os.W_OK)
    yield Finding(
        "Cache",
        f"{folder}: {len(files)} compiled kernels, {size / 1e6:.1f} MB"
        + ("" if writable else "; not writable: each process compiles its kernels anew"),
        writable,
    )


def _trace() -> Finding:
    """Trace a lens as every run does, with the time and the rounding error that it has here."""
    import torch

    from dolens.optics.rays import Rays
    from dolens.prescriptions import load_lens

    def traced(dtype: torch.dtype) -> tuple[torch.Tensor, float]:
        lens = load_lens("cooke_triplet", dtype=dtype)
        place = start.to(dtype)
        rays = Rays(place, place.new_tensor([0.0, 0.0, 1.0]), 587.5618)
        seconds = []
        for _ in range(4):  # the first may compile
            started = time.perf_counter()
            hit = lens.trace(rays)
            seconds.append(time.perf_counter() - started)
        return hit.position.double(), min(seconds[1:])

    generator = torch.Generator().manual_seed(0)
    start = 8.0 * torch.rand((100_000, 3), generator=generator) - 4.0  # mm, within the pupil
    start[:, 2] = -10.0
    with torch.no_grad():
        single, seconds = traced(torch.float32)
        double, _ = traced(torch.float64)
    error = (single - double).abs().max().item() * 1e6
    return Finding(
        "Trace",
        f"100 000 rays through the Cooke triplet in {1e3 * seconds:.1f} ms, float32; "
        f"at most {error:.0f} nm from float64",
        error < 100.0,
    )


def _extras() -> Iterator[Finding]:
    import importlib.metadata

    from dolens.files import installed_version

    known = importlib.metadata.metadata("dolens").get_all("Provides-Extra") or []
    for extra, purpose in EXTRAS.items():
        if extra not in known:
            yield Finding(extra, "not of this installation of dolens: install it anew", False)
            continue
        missing = [
            f"{name}{wanted}" for name, wanted in _packages_of(extra) if not _meets(name, wanted)
        ]
        old = [name for name in missing if installed_version(name.split(">")[0])]
        state = "installed" if not missing else f"missing: {', '.join(missing)}"
        if old:
            state += f" (an older {', '.join(part.split('>')[0] for part in old)} is installed)"
        yield Finding(extra, f"{state}; for {purpose}", not missing)


def _packages_of(extra: str) -> Iterator[tuple[str, str]]:
    """Yield the names of an extra's packages, and the versions that it allows."""
    import importlib.metadata

    from packaging.requirements import Requirement

    for text in importlib.metadata.requires("dolens") or []:
        found = Requirement(text)
        if found.marker is None or not found.marker.evaluate({"extra": extra}):
            continue
        if found.marker.evaluate({"extra": ""}):  # a package that all of dolens needs
            continue
        if found.name == "dolens":
            for other in sorted(found.extras):
                yield from _packages_of(other)
        else:
            yield found.name, str(found.specifier)


def _meets(package: str, wanted: str) -> bool:
    from packaging.specifiers import SpecifierSet

    from dolens.files import installed_version

    version = installed_version(package)
    return version is not None and SpecifierSet(wanted).contains(version, prereleases=True)


def _photographs() -> Iterator[Finding]:
    from dolens.errors import InputError

    try:
        from dolens.experiments.data import package_photographs as photographs
    except ModuleNotFoundError as error:
        yield Finding("Photographs", f"none without '{error.name}', of the extra train", False)
        return
    try:
        yield Finding("Photographs", f"those of scikit-image, {photographs.photographs_folder()}")
    except InputError as error:
        yield Finding("Photographs", str(error), False)
    entries = photographs.read_manifest(photographs.MANIFEST)
    try:
        photographs.locate(entries, photographs.data_folders())
    except InputError as error:
        yield Finding("data=package_photographs", str(error), False)
    else:
        yield Finding("data=package_photographs", f"all {len(entries)} found")


def _fonts() -> Finding:
    from matplotlib.font_manager import findfont

    try:
        return Finding("Font of figures", findfont("DejaVu Sans", fallback_to_default=False))
    except ValueError:
        return Finding("Font of figures", "DejaVu Sans, which Matplotlib brings, is missing", False)


def _completion() -> Finding:
    shell = Path(os.environ.get("SHELL", "")).name
    files = (
        ".bash_completions/dolens.sh",
        ".zfunc/_dolens",
        ".config/fish/completions/dolens.fish",
    )
    try:
        found = [path for path in (Path.home() / name for name in files) if path.exists()]
    except RuntimeError:  # the user has no home folder
        found = []
    if found:
        return Finding("Completion", str(found[0]))
    hint = "dolens --install-completion installs it"
    return Finding("Completion", f"not installed{f' for {shell}' if shell else ''}; {hint}", False)
