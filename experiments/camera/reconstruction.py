"""Any network and any loss behind the interfaces that a camera uses, checked before training."""

import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dolens.errors import InputError, one_line
from dolens.reconstruction import Restoration
from dolens.reconstruction.processes import mean_over_processes
from dolens.sensor.colour import linear_to_srgb

# Of restored and true images (B, 3, H, W), display-encoded, to a number or a mapping with `total`.
Loss = Callable[[Tensor, Tensor], Tensor | Mapping[str, Tensor]]


class ImageNetwork(Restoration):
    """A network of images alone behind the interface of `Restoration`.

        restored = network(sRGB(raw))

    Args:
        network: maps display-encoded images (B, 3, H, W) to such images.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.pretrained = getattr(network, "pretrained", False) is True

    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
    ) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; the rest is not looked at."""
        return self.network(linear_to_srgb(raw.to(self.dtype)))


def restoration_of(network: Any) -> Restoration:
    """Return a network behind the interface of `Restoration`: itself, or an `ImageNetwork`.

    Raises:
        InputError: it is no `torch.nn.Module`.
    """
    if isinstance(network, Restoration):
        return network
    if not isinstance(network, nn.Module):
        raise InputError(f"network: {_name(network)} is no torch.nn.Module")
    return ImageNetwork(network)


def loss_terms(loss: Loss, restored: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Return the terms of a loss by name, with the number to minimise as `total`.

    Args:
        loss: gives a number (a tensor without dimensions), or a mapping with one as `total`.
        restored: (B, 3, H, W), display-encoded.
        truth: of the same shape.

    Raises:
        InputError: the loss gives something else.
    """
    found = loss(restored, truth)
    terms = dict(found) if isinstance(found, Mapping) else {"total": found}
    if "total" not in terms:
        names = ", ".join(map(str, terms)) or "nothing"
        raise InputError(
            f"loss: {_name(loss)} gives {names} and no 'total', the number to be minimised"
        )
    total = terms["total"]
    if not isinstance(total, Tensor) or total.dim() > 0:
        raise InputError(
            f"loss: {_name(loss)} gives {_described(total)} as the number to be minimised; "
            "allowed: a tensor without dimensions"
        )
    return {name: torch.as_tensor(value) for name, value in terms.items()}


def loss_over_views(
    loss: Loss, restored: Tensor, truth: Tensor, norm: float, shared: bool = False
) -> dict[str, Tensor]:
    """Return a loss and its terms for images of several views.

    Terms are means over the V views.  The total is the power mean (Σ L_v^p / V)^(1/p) of the views'
    totals: at p = 1 their mean, and the larger p is, the more the worst one counts, which is what
    an extended depth of field is for.

    Args:
        loss: of the images of one view.
        restored: (B, V, 3, H, W), display-encoded.
        truth: of the same shape.
        norm: p, at least 1.
        shared: whether the images are one process's equal part of a batch, of which the loss is to
            be; all processes must call this.

    Raises:
        InputError: the loss gives no total, or a negative one for p > 1.
    """
    rows = [loss_terms(loss, restored[:, v], truth[:, v]) for v in range(restored.shape[1])]
    terms = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
    if shared:
        # The power mean is not linear: the views' losses are averaged before it.
        terms = {name: mean_over_processes(values) for name, values in terms.items()}
    totals = terms["total"]
    largest = totals.detach().amax().clamp(min=torch.finfo(restored.dtype).tiny)
    negative = (totals.detach() < 0.0).any()
    if norm == 1.0:
        largest = torch.where(negative, torch.ones_like(largest), largest)
    elif bool(negative):
        raise InputError(
            f"view_norm: {norm:g} needs a loss that is not negative, and {_name(loss)} gives "
            f"{float(totals.detach().amin()):.3g}; give view_norm=1"
        )
    total = largest * ((totals / largest) ** norm).mean() ** (1.0 / norm)
    return {name: value.mean() for name, value in terms.items()} | {"total": total}


def check_reconstruction(
    network: Restoration,
    loss: Loss,
    size: Sequence[int],
    functions: int,
    images: int | None = None,
    readouts: int | None = None,
) -> None:
    """Try a network and a loss on one image before anything is trained.

    Neither random numbers nor statistics of the network are changed.

    Args:
        network: to be tried.
        loss: to be tried on its image.
        size: height and width of the camera's images, pixels.
        functions: number of point spread functions that the camera gives.
        images: 1 where it gives each image its own; None where they are those of all.
        readouts: of an image; None: one, and no list of it.

    Raises:
        InputError: the network or the loss fails, or gives something else than is needed.
    """
    name = _name(network.network if isinstance(network, ImageNetwork) else network)
    several = [] if readouts is None else [readouts]
    raw = torch.zeros(1, *several, 3, *size)
    psf = field = None
    if network.needs_point_spread_function:
        psf = torch.zeros(*[] if images is None else [images], *several, functions, 3, 3, 3)
        psf[..., 1, 1] = 1.0
    if network.needs_field:
        field = torch.zeros(1, 2, *size)
    with evaluating(network), torch.no_grad(), torch.random.fork_rng(devices=()):
        level = (0.01, 1e-4)
        noise = network.noise_arguments(level if readouts is None else [level] * readouts)
        restored = _tried("network", name, raw, lambda: network(raw, psf, field, *noise))
        wanted = ((1, 3, *size), network.dtype)
        if not isinstance(restored, Tensor) or (tuple(restored.shape), restored.dtype) != wanted:
            raise InputError(
                f"network: {name} gives {_described(restored)} for an image of shape "
                f"{wanted[0]}; needed: the same shape, {network.dtype}"
            )
        truth = torch.zeros_like(restored)
        _tried("loss", _name(loss), raw, lambda: loss_terms(loss, restored, truth))


def compile_network(network: nn.Module, device: torch.device) -> None:
    """Let `torch.compile` make a network, in its place; the names of its weights stay.

    Args:
        network: compiled when it is called next, in training and in evaluation mode by itself.
        device: that it is on.

    Raises:
        InputError: torch cannot compile here, as without a C++ compiler.
    """
    try:
        torch.compile(lambda number: 2.0 * number)(torch.ones(1, device=device))
    except Exception as error:
        raise InputError(
            f"compile_network: torch.compile does not work here ({one_line(error)[:200]}); "
            "allowed: false"
        ) from error
    network.compile()


@contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """Put a network and all its parts into evaluation mode, and back into their own afterwards."""
    training = [(part, part.training) for part in network.modules()]
    network.eval()
    try:
        yield
    finally:
        for part, mode in training:
            part.training = mode


def _tried(key: str, name: str, raw: Tensor, call: Callable[[], Any]) -> Any:
    """Return what a call gives.

    Raises:
        InputError: it fails; one line says how, and where in the code.
    """
    try:
        return call()
    except InputError:
        raise
    except Exception as error:
        message = one_line(error)
        raise InputError(
            f"{key}: {name} fails on an image of shape {tuple(raw.shape)}: "
            f"{type(error).__name__}: {message}{_place(error)}"
        ) from error


def _place(error: Exception) -> str:
    """Return the last line of code outside torch and this file that led to an error, if any."""
    known = (str(Path(torch.__file__).parent), __file__)
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(known)]
    return f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""


def _name(thing: Any) -> str:
    """Return the name of a function, of what a partial calls, or of an object's class."""
    thing = getattr(thing, "func", thing)
    return getattr(thing, "__name__", type(thing).__name__)


def _described(value: Any) -> str:
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}"
    return f"a tensor of shape {tuple(value.shape)}, {value.dtype}"
