"""A GPU that is pretended: tensors of the CPU that say `cuda`, and refuse what CUDA refuses.

A machine without a GPU finds so what would fail on one: operations that mix tensors of both
devices, NumPy arrays of tensors on the GPU, and generators of random numbers of the other device.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

GPU = torch.device("cuda", 0)
aten = torch.ops.aten
# Operations that take tensors of both devices: copies, and indices that the CPU holds.
_MIXING = {
    aten.copy_.default,
    aten._to_copy.default,
    aten.index.Tensor,
    aten.index_put.default,
    aten.index_put_.default,
    aten._index_put_impl_.default,
}
_DATA = (torch.tensor, torch.as_tensor, torch.asarray)


def _each(function: Callable[[Tensor], Any], value: Any) -> Any:
    """Return what an operation takes or returns, with a function of every tensor in its place.

    PyTorch's own trees know more kinds of containers, and take three times as long.
    """
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, list | tuple):
        return type(value)([_each(function, part) for part in value])
    if isinstance(value, dict):
        return {key: _each(function, part) for key, part in value.items()}
    return value


@cache
def _names(func: Any) -> list[str]:
    """Return the names of an operation's arguments."""
    return [argument.name for argument in func._schema.arguments]


def _run(
    of: Any,
    func: Any,
    types: Any,
    args: Sequence[Any] = (),
    kwargs: Mapping[str, Any] | None = None,
) -> Any:
    """Run an operation by the CPU, and say where its results are: `__torch_dispatch__`."""
    kwargs = dict(kwargs or {})
    tensors: list[Tensor] = []
    _each(tensors.append, (args, kwargs))
    here = [t for t in tensors if isinstance(t, OnGpu)]
    sized = [t for t in tensors if not isinstance(t, OnGpu) and t.dim() > 0]
    if here and sized and func not in _MIXING:
        raise RuntimeError(f"Expected all tensors to be on the same device: {func}")
    if here and func is aten.index.Tensor and not isinstance(args[0], OnGpu):
        raise RuntimeError("indices should be on the CPU, as what they index")
    on_gpu = bool(here)
    names = _names(func)[: len(args)]
    if "device" in names:  # without its name, as in inference mode
        first = names.index("device")
        args, kwargs = (
            args[:first],
            {**dict(zip(names[first:], args[first:], strict=True)), **kwargs},
        )
    if kwargs.get("device") is not None:
        on_gpu = torch.device(kwargs["device"]).type != "cpu"
        kwargs["device"] = torch.device("cpu")
    generator = kwargs.get("generator")
    if isinstance(generator, Generator) and (generator.device.type == "cuda") != on_gpu:
        raise RuntimeError(f"Expected a generator of the device of the tensor: {func}")
    own, named = _each(lambda x: x.numbers if isinstance(x, OnGpu) else x, (args, kwargs))
    if torch.Tag.inplace_view in func.tags:
        func(*own, **named)
        with torch._C._DisableTorchDispatch():
            func(*args, **kwargs)  # the shape of the tensor without numbers
        return args[0]
    found = func(*own, **named)
    if func is aten.copy_.default:
        return args[0]
    if not on_gpu:
        return found
    given = {id(t.numbers): t for t in here}

    def placed(result: Tensor) -> OnGpu:
        # A conjugate that is not yet taken shows on the CPU's tensor alone.
        return given[id(result)] if id(result) in given else OnGpu(result.resolve_conj())

    return _each(placed, found)


class Generator(torch.Generator):
    """A generator of the CPU's numbers that may say that it is the GPU's."""

    said: torch.device

    def __new__(cls, device: Any = "cpu") -> "Generator":
        made = super().__new__(cls, "cpu")
        made.said = torch.device(device)
        return made

    device = property(lambda self: self.said)


class OnGpu(Tensor):
    """A tensor that says that it is on the GPU; its numbers are in `numbers`, on the CPU.

    For PyTorch's C++ it is a tensor without numbers (`meta`), which any machine can have.
    """

    numbers: Tensor

    @staticmethod
    def __new__(cls, numbers: Tensor, requires_grad: bool = False) -> "OnGpu":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            numbers.size(),
            strides=numbers.stride(),
            storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype,
            device="meta",
            requires_grad=requires_grad,
        )
        made.numbers = numbers
        return made

    device = property(lambda self: GPU)
    is_cuda = property(lambda self: True)
    is_cpu = is_meta = property(lambda self: False)

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("a tensor on the GPU has no NumPy array: copy it to the CPU first")

    __array__ = numpy

    def tolist(self) -> Any:
        return self.detach().numbers.tolist()

    def __deepcopy__(self, memo: dict[int, Any]) -> "OnGpu":
        made = OnGpu(self.detach().numbers.clone()).requires_grad_(self.requires_grad)
        if isinstance(self, torch.nn.Parameter):
            made._is_param = True
        memo[id(self)] = made
        return made

    __torch_dispatch__ = classmethod(_run)


class _Data(TorchFunctionMode):
    """Tensors from data in which there are tensors of the GPU."""

    def __torch_function__(
        self,
        func: Any,
        types: Any,
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        kwargs = dict(kwargs or {})
        if func is Tensor.new_tensor and isinstance(args[0], OnGpu):
            return torch.tensor(args[1], **{"dtype": args[0].dtype, "device": GPU, **kwargs})
        if func is Tensor.__getitem__ and isinstance(args[1], list):
            # Of a list PyTorch would make a tensor without numbers.
            return args[0][torch.tensor(args[1])]
        if func in _DATA and isinstance(args[0], OnGpu):
            data = args[0].detach() if func is torch.tensor else args[0]
            return data.to(**{k: v for k, v in kwargs.items() if k in ("dtype", "device")})
        if func in _DATA and isinstance(args[0], list | tuple):
            plain = _each(lambda x: x.tolist() if isinstance(x, OnGpu) else x, args[0])
            return func(plain, *args[1:], **kwargs)
        return func(*args, **kwargs)


class PretendedGpu(TorchDispatchMode):
    """Within it `cuda` is a device on any machine."""

    __torch_dispatch__ = _run

    def __enter__(self) -> "PretendedGpu":
        torch._C._ensureCUDADeviceGuardSet()
        self._before = torch._C._only_lift_cpu_tensors(), torch.Generator
        self._cuda = torch.cuda._lazy_init, torch.cuda.current_device
        self._overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
        torch._C._set_only_lift_cpu_tensors(True)
        torch.cuda._lazy_init, torch.cuda.current_device = lambda: None, lambda: 0
        torch.Generator = Generator
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        self._data = _Data()
        self._data.__enter__()
        return super().__enter__()

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        self._data.__exit__(*raised)
        lifts, torch.Generator = self._before
        torch.cuda._lazy_init, torch.cuda.current_device = self._cuda
        torch._C._set_only_lift_cpu_tensors(lifts)
        torch.__future__.set_overwrite_module_params_on_conversion(self._overwrites)
