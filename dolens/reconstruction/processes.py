"""Statistics of a batch that several processes share: all of it counts, as for one process.

A process works on its part of a batch, and the gradients of all are averaged afterwards.  That is
the gradient of the whole batch where its loss is a mean over images.  What is not, such as a batch
normalisation's statistics, is averaged over the processes first, with the derivative of that.
Without a process group each function is that of one process, to the bit.
"""

from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.nn import functional
from torch.nn.modules.batchnorm import _BatchNorm


def processes() -> int:
    """Return the number of processes that share a batch; 1 without a process group."""
    there = distributed.is_available() and distributed.is_initialized()
    return distributed.get_world_size() if there else 1


def mean_over_processes(value: Tensor) -> Tensor:
    """Return the mean of each process's value, differentiable; every process must call it.

    Args:
        value: any shape, the same in all processes.
    """
    return value if processes() == 1 else _Mean.apply(value)


def gathered(own: Any) -> list[Any]:
    """Return what every process has, in their order; every process must call it.

    Args:
        own: plain values and tensors on the CPU.
    """
    found: list[Any] = [own]
    if processes() > 1:
        found = [None] * processes()
        distributed.all_gather_object(found, own)
    return found


class _Mean(torch.autograd.Function):
    """Averages values forwards, and their gradients backwards."""

    @staticmethod
    def forward(context: Any, value: Tensor) -> Tensor:
        return _averaged(value)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> Tensor:
        return _averaged(gradient)


def _averaged(value: Tensor) -> Tensor:
    total = value.detach().clone(memory_format=torch.contiguous_format)
    distributed.all_reduce(total)
    return total / processes()


@torch.no_grad()
def average_gradients(module: nn.Module) -> None:
    """Average the gradients of a module that no strategy looks after, over the processes."""
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    if processes() == 1 or not gradients:
        return
    flat = _averaged(torch.cat([gradient.reshape(-1) for gradient in gradients]))
    parts = flat.split([gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view_as(gradient))


class SharedBatchNorm(_BatchNorm):
    """Normalises by the statistics of the whole batch, of which each process has an equal part.

    It is `torch.nn.SyncBatchNorm`, which has no implementation for CPUs, with parameters and
    buffers of the same names as `torch.nn.BatchNorm2d`.

    Attributes:
        stands_for: the class that it replaces.
    """

    stands_for: type[_BatchNorm] = nn.BatchNorm2d

    def _check_input_dim(self, input: Tensor) -> None:
        """Accept images, volumes and signals: the layer that this one stands for has checked."""

    def forward(self, input: Tensor) -> Tensor:
        """Normalise (B, C, ...)."""
        if not self.training or processes() == 1:
            return super().forward(input)
        momentum = 0.0
        if self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
            momentum = self.momentum or 1.0 / float(self.num_batches_tracked)
        found, mean, variance = _Normalise.apply(input, self.weight, self.bias, self.eps)
        if self.running_mean is not None and self.running_var is not None:
            count = processes() * input.numel() // input.shape[1]
            unbiased = variance * (count / max(count - 1, 1))
            self.running_mean.lerp_(mean.to(self.running_mean), momentum)
            self.running_var.lerp_(unbiased.to(self.running_var), momentum)
        return found


class _Normalise(torch.autograd.Function):
    """Batch normalisation with statistics of all processes, and its derivative."""

    @staticmethod
    def forward(
        context: Any, image: Tensor, weight: Tensor | None, bias: Tensor | None, epsilon: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        precise = image.float() if image.dtype in (torch.bfloat16, torch.float16) else image
        variance, mean = torch.var_mean(precise, _all_but_channels(image), correction=0)
        # Of equal parts: the mean of variances, and the variance of means.
        parts = [torch.empty(2, len(mean)).to(mean) for _ in range(processes())]
        distributed.all_gather(parts, torch.stack((mean, variance)))
        means, variances = torch.stack(parts).unbind(1)
        mean = means.mean(0)
        variance = variances.mean(0) + (means - mean).square().mean(0)
        found = functional.batch_norm(image, mean, variance, weight, bias, False, 0.0, epsilon)
        context.save_for_backward(image, weight, mean, (variance + epsilon).rsqrt())
        context.mark_non_differentiable(mean, variance)
        return found, mean, variance

    @staticmethod
    def backward(context: Any, gradient: Tensor, *others: Any) -> tuple[Tensor | None, ...]:
        image, weight, mean, inverse = context.saved_tensors
        along, shape = _all_but_channels(image), (-1, *[1] * (image.dim() - 2))
        gradient = gradient.to(mean.dtype)
        normalised = (image.to(mean.dtype) - mean.view(shape)) * inverse.view(shape)
        of_bias, of_weight = gradient.sum(along), (gradient * normalised).sum(along)
        count = image.numel() // image.shape[1]
        shift, slope = _averaged(torch.stack((of_bias, of_weight)) / count)
        found = gradient - shift.view(shape) - normalised * slope.view(shape)
        factor = inverse if weight is None else inverse * weight
        found = (found * factor.view(shape)).to(image.dtype)
        if weight is None:
            return found, None, None, None
        return found, of_weight.to(weight), of_bias.to(weight), None


def _all_but_channels(image: Tensor) -> list[int]:
    return [0, *range(2, image.dim())]


def share_batch_statistics(module: nn.Module) -> nn.Module:
    """Return a module whose batch normalisations are over the batch of all processes.

    Parts that are batch normalisations are replaced by others with the same parameters and buffers.
    """
    for name, part in module.named_children():
        setattr(module, name, share_batch_statistics(part))
    if not isinstance(module, _BatchNorm) or isinstance(module, SharedBatchNorm):
        return module
    shared = _as(SharedBatchNorm, module)
    shared.stands_for = type(module)  # type: ignore[assignment]
    return shared


def own_batch_statistics(module: nn.Module) -> nn.Module:
    """Undo `share_batch_statistics`."""
    for name, part in module.named_children():
        setattr(module, name, own_batch_statistics(part))
    return _as(module.stands_for, module) if isinstance(module, SharedBatchNorm) else module


def _as(kind: type[_BatchNorm], module: _BatchNorm) -> _BatchNorm:
    """Return a batch normalisation of another class, with the same parameters and buffers."""
    made = kind(
        module.num_features,
        module.eps,
        module.momentum,
        affine=module.affine,
        track_running_stats=module.track_running_stats,
    )
    for name in ("weight", "bias", "running_mean", "running_var", "num_batches_tracked"):
        setattr(made, name, getattr(module, name))
    return made.train(module.training)
