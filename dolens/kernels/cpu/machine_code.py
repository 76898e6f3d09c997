"""Machine code of a compiled kernel: taken from Numba, and loaded from a file without it.

Numba's own cache is a pickle of the compiler's objects.  A kernel here is one C function that needs
none of them: the object code that LLVM made is enough.
"""

from typing import Any, NamedTuple

from llvmlite import binding
from numba.core import registry
from numba.core.ccallback import CFunc
from numba.core.runtime import rtsys

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
