"""Paths of other programs: the command line's words, what is skipped, and versions."""

import re
import sys
import types
from collections.abc import Mapping, Sequence
from importlib.metadata import distributions
from pathlib import Path
from subprocess import run

from benchmarks.peer_programs import PEERS, DeepLens, Peer
from dolens.errors import InputError


def parse(words: Sequence[str]) -> dict[str, Path]:
    """Read paths of peers from words: `do=PATH deeplens=PATH optiland=PATH`.

    Raises:
        InputError: a word of another form, an unknown name, or a path without the program.
    """
    known = {peer.word: peer for peer in PEERS}
    found = {}
    for word in words:
        name, equals, path = word.partition("=")
        if not equals or name not in known:
            raise InputError(
                f"--peers: '{word}' is not of the form NAME=PATH with NAME one of "
                f"{', '.join(known)}"
            )
        folder = Path(path).expanduser().resolve()
        if not (folder / known[name].module / "__init__.py").is_file():
            raise InputError(f"--peers: {name}: there is no '{known[name].module}' in {path}")
        found[name] = folder
    return found


def skipped(paths: Mapping[str, Path]) -> list[str]:
    """A line for every peer that was not given."""
    return [
        f"SKIPPED: {peer.name}, because no path was given (--peers {peer.word}=PATH)"
        for peer in PEERS
        if peer.word not in paths
    ]


def make_importable(paths: Mapping[str, Path]) -> None:
    """Let `import` find them, behind everything that is installed."""
    for word, folder in paths.items():
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
        if word == DeepLens.word and "deeplens" not in sys.modules:
            package = types.ModuleType("deeplens")
            package.__path__ = [str(folder / "deeplens")]
            sys.modules["deeplens"] = package


def describe(paths: Mapping[str, Path]) -> str:
    """Return the peers that run, and their versions as far as their folders tell."""
    return "; ".join(
        f"{peer.name} {_version(peer, paths[peer.word])}"
        if peer.word in paths
        else f"no {peer.name}"
        for peer in PEERS
    )


def _version(peer: type[Peer], folder: Path) -> str:
    if (folder / ".git").exists():
        words = ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"]
        return run(words, capture_output=True, text=True, check=False).stdout.strip()
    for found in distributions(path=[str(folder)]):
        # DeepLens is `deeplens-core` on PyPI.
        if found.name.removesuffix("-core") == peer.module:
            return found.version
    # What a checkout without its history says of itself.
    for file in (folder / "pyproject.toml", folder / peer.module / "version.py"):
        if file.is_file():
            said = re.search(r"""version(?:__)?\s*=\s*["']([^"']+)""", file.read_text("utf-8"))
            if said:
                return said[1]
    return "of unknown version"
