"""Train a network on images of fixed optics, and judge it, in seconds of one processor."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.experiments.camera.reconstruction import loss_over_views
from dolens.reconstruction import Restoration, RestorationLoss, psnr_db
from scripts.reconstruction.fixed_optics import FixedOptics, Split

_VIEW_NORM = 4.0  # as conf/wavefront_camera.yaml
_BETAS = (0.9, 0.99)  # as conf/optimizer/camera.yaml
_TEST_SEED = 10**6


@dataclass(frozen=True)
class Trained:
    """A network that was trained.

    Attributes:
        network: in evaluation mode.
        seconds: of one processor, for all steps; images were made before.
        steps: that it took.
    """

    network: Restoration
    seconds: float
    steps: int


def train(
    make: Callable[[], Restoration],
    optics: FixedOptics,
    steps: int,
    seed: int,
    learning_rate: float = 0.002,
) -> Trained:
    """Train a network as the camera experiment does, but for the lens, which stays.

    The seed decides its first weights, the order of the crops and the noise.  The learning rate
    falls to zero along a cosine.
    """
    torch.manual_seed(seed)
    network = make().train()
    loss = RestorationLoss(perceptual="none")
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate, betas=_BETAS)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=steps)
    order = _order(len(optics.splits["train"].images), steps * optics.batch, seed)
    seconds = 0.0
    for step in range(steps):
        chosen = order[step * optics.batch : (step + 1) * optics.batch]
        images = optics.splits["train"].images[chosen]
        truth = optics.splits["train"].truth[chosen].float()
        raw = optics.raw(images, seed * 100_000 + step)
        started = time.process_time()
        restored = network(raw.flatten(0, 1), optics.functions, None).unflatten(0, raw.shape[:2])
        total = loss_over_views(loss, restored, truth[:, None].expand_as(raw), _VIEW_NORM)["total"]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        scheduler.step()
        seconds += time.process_time() - started
    return Trained(network.eval(), seconds, steps)


@torch.no_grad()
def scores(network: Restoration, optics: FixedOptics, split: str) -> Tensor:
    """Return the PSNR in dB of every photograph at every depth, (P, D)."""
    chosen = optics.splits[split]
    found = [psnr_db(*_pair(network, optics, chosen, n)) for n in range(len(chosen.images))]
    return by_photograph(torch.stack(found), chosen.photographs)


def restored(network: Restoration, optics: FixedOptics, split: str, number: int) -> Tensor:
    """Return one crop, restored at every depth, (D, 3, H, W), sRGB within 0 and 1."""
    with torch.no_grad():
        return _pair(network, optics, optics.splits[split], number)[0]


def by_photograph(values: Tensor, photographs: Sequence[str]) -> Tensor:
    """Average crops (N, D) over those of each photograph."""
    names = list(dict.fromkeys(photographs))
    rows = [
        torch.stack([v for v, of in zip(values, photographs, strict=True) if of == name]).mean(0)
        for name in names
    ]
    return torch.stack(rows)


def _pair(network: Restoration, optics: FixedOptics, split: Split, n: int) -> tuple[Tensor, Tensor]:
    raw = optics.raw(split.images[n], _TEST_SEED + n)
    found = network(raw, optics.functions, None).clamp(0.0, 1.0)
    return found, split.truth[n].float().expand_as(found)


def _order(count: int, needed: int, seed: int) -> Tensor:
    """Return numbers of crops, all of them before any comes again."""
    generator = torch.Generator().manual_seed(seed)
    rounds = -(-needed // count)
    return torch.cat([torch.randperm(count, generator=generator) for _ in range(rounds)])[:needed]
