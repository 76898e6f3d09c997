"""Compiled kernels are kept as machine code in the user's cache folder, one file a kernel.

A file's name is a digest of all that decides its content: the kernels' sources, Python, Numba and
LLVM, and the processor with its features.  So machines that share a home folder do not meet in a
file, and processes that compile at the same time write the same content: each writes a file of its
own and renames it, and the last one stays.

A file holds machine code and the name of its function, behind a digest of both and of what the
kernel was made from; no Python object is in it, and nothing is unpickled, as it is by Numba's own
cache.  The digest finds damage, and files that were exchanged.  Machine code is executed, of
course, so a file counts only if this user (or root) owns it and nobody else may write to it; what a
user runs can write such files too, as it can write the user's Python packages.
"""

import hashlib
import logging
import os
import platform
import stat
import sys
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import numba
from llvmlite import binding
from numba.core import config, registry
from numba.core.ccallback import CFunc
from numba.core.runtime import rtsys

from dolens.files import delete_old, user_cache_folder, write_whole

# Machine code lives as long as the engine that loaded it, and kernels as long as the process.
_engines: list[binding.ExecutionEngine] = []


class MachineCode(NamedTuple):
    """A kernel as an object file.

    Attributes:
        function: the symbol of the C function.
        code: the content of the object file, in the system's format.
    """

    function: str
    code: bytes


def target() -> tuple:
    """Return what decides the machine code: the system, the processor and its features."""
    return registry.cpu_target.target_context.codegen().magic_tuple()


def taken_from(compiled: CFunc) -> MachineCode:
    """Return the machine code of a compiled function."""
    library: Any = compiled._library  # type: ignore[attr-defined]
    _, _, (code, _) = library.serialize_using_object_code()
    return MachineCode(compiled.native_name, code)


def load(kernel: MachineCode) -> int:
    """Load machine code for the rest of the process; return the function's address.

    Each kernel has an engine of its own: names of one are not seen by another.

    Raises:
        RuntimeError: it is not for this system, or has no such function.
    """
    context = registry.cpu_target.target_context
    rtsys.initialize(context)  # symbols of Numba's runtime
    triple = target()[0]
    module = binding.parse_assembly("")
    module.triple = triple
    machine = binding.Target.from_triple(triple).create_target_machine(jit=True)
    engine = binding.create_mcjit_compiler(module, machine)
    engine.add_object_file(binding.ObjectFileRef.from_data(kernel.code))
    engine.finalize_object()
    address = engine.get_function_address(kernel.function)
    if not address:
        raise RuntimeError(f"no function {kernel.function}")
    _engines.append(engine)
    return address


logger = logging.getLogger("dolens.kernels")

_DIGEST = hashlib.sha256().digest_size
# What has been said of the cache's folder: every kernel would say it again.
_said: set[str] = set()


def cache_folder() -> Path:
    """Return the folder of compiled kernels.

    It is NUMBA_CACHE_DIR where that is set, and else `dolens/kernels` in the user's cache folder.

    Raises:
        RuntimeError: the user has no home folder.
    """
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR) / "dolens"
    return user_cache_folder() / "kernels"


class KernelFiles:
    """The file of one kernel.

    A file that cannot be written costs only the cache, and one that is damaged is replaced.

    Args:
        name: of the kernel, for people who look into the folder.
        stamp: digest of the sources that all kernels have in common.
        source: what tells this kernel from others.
        target: what Numba's code generator says of the processor that it compiles for.
    """

    def __init__(
        self, name: str, stamp: str, source: tuple[str, ...], target: tuple[Any, ...]
    ) -> None:
        versions = (sys.version, platform.machine(), numba.__version__, llvmlite.__version__)
        self._key = repr((stamp, source, versions, target)).encode()
        self.folder = cache_folder() / stamp[:16]
        self.path = self.folder / f"{name}-{hashlib.sha256(self._key).hexdigest()[:32]}.kernel"

    def read(self) -> MachineCode | None:
        """Return the compiled kernel, or None where there is none that could be used."""
        try:
            with open(self.path, "rb") as file:
                if not is_private(os.fstat(file.fileno())):
                    logger.warning(
                        "a compiled kernel on disk is not used: others may have written it (%s)",
                        self.path,
                    )
                    return None
                content = file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            _say_once("compiled kernels on disk cannot be read", error)
            return None
        digest, payload = content[:_DIGEST], content[_DIGEST:]
        if self._digest(payload) != digest:
            logger.warning("a compiled kernel on disk is damaged and made anew: %s", self.path)
            return None
        function, _, code = payload.partition(b"\0")
        return MachineCode(function.decode(), code)

    def write(self, kernel: MachineCode) -> None:
        """Keep a compiled kernel for the next process."""
        payload = kernel.function.encode() + b"\0" + kernel.code
        try:
            if not self.folder.is_dir():
                for folder in (self.folder.parent, self.folder):
                    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                delete_old(self.folder.parent)
            write_whole(self.path, self._digest(payload) + payload)
        except OSError as error:
            _say_once("compiled kernels cannot be kept for the next start", error)

    def _digest(self, payload: bytes) -> bytes:
        """Return the digest that stands before a payload; another kernel's file has another."""
        return hashlib.sha256(self._key + payload).digest()


def is_private(status: os.stat_result) -> bool:
    """Return whether nobody but this user or root can have written a file.

    Windows keeps a user's cache folder from others by itself.
    """
    if not hasattr(os, "geteuid"):
        return True
    others = stat.S_IWGRP | stat.S_IWOTH
    return status.st_uid in (os.geteuid(), 0) and not status.st_mode & others


def _say_once(what: str, error: OSError) -> None:
    if what not in _said:
        _said.add(what)
        logger.warning("%s: %s", what, error)
