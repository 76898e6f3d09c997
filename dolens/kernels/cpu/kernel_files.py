"""Compiled kernels are kept in files of the user's cache folder, one file a kernel.

A file's name is a digest of all that decides its content: the kernels' sources, Python, Numba and
LLVM, and the processor with its features.  So machines that share a home folder do not meet in a
file, and processes that compile at the same time write the same content: each writes a file of its
own and renames it, and the last one stays.

Files belong to one user: they hold machine code, and nobody else may write there.
"""

import hashlib
import logging
import pickle
import platform
import sys
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core import config
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from dolens.user_cache import delete_old, user_cache_folder, write_whole

logger = logging.getLogger("dolens.kernels")

_DIGEST = hashlib.sha256().digest_size


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
    """Numba's cache of one kernel: a file with machine code.

    A file that cannot be written costs only the cache, and one that is damaged is replaced.

    Args:
        name: of the kernel, for people who look into the folder.
        stamp: digest of the sources that all kernels have in common.
        source: what tells this kernel from others.
    """

    def __init__(self, name: str, stamp: str, source: tuple[str, ...]) -> None:
        self.name, self.source = name, source
        self.folder = cache_folder() / stamp[:16]

    def path(self, codegen: Any) -> Path:
        """Return the kernel's file for the processor that Numba's `codegen` compiles for."""
        versions = (sys.version, platform.machine(), numba.__version__, llvmlite.__version__)
        key = repr((self.source, versions, codegen.magic_tuple()))
        return self.folder / f"{self.name}-{hashlib.sha256(key.encode()).hexdigest()[:32]}.kernel"

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """Return the compiled kernel, or None where there is none."""
        # Numba's own cache prepares to compile first, which imports SciPy and half of Numba
        # (0.6 s); compiled code needs the runtime's symbols only.
        rtsys.initialize(target_context)
        path = self.path(target_context.codegen())
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            logger.warning("compiled kernels on disk cannot be read: %s", error)
            return None
        digest, payload = content[:_DIGEST], content[_DIGEST:]
        if hashlib.sha256(payload).digest() != digest:
            logger.warning("a compiled kernel on disk is damaged and made anew: %s", path)
            return None
        return CompileResult._rebuild(target_context, *pickle.loads(payload))

    def save_overload(self, sig: Any, data: CompileResult) -> None:
        """Keep a compiled kernel for the next process."""
        payload = dumps(data._reduce())
        try:
            if not self.folder.is_dir():
                self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                delete_old(self.folder.parent)
            write_whole(self.path(data.codegen), hashlib.sha256(payload).digest() + payload)
        except OSError as error:
            logger.warning("compiled kernels cannot be kept for the next start: %s", error)
