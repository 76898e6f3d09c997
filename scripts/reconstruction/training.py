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
_RATE = 0.002  # as conf/wavefront_camera.yaml
_TEST_SEED = 10**6
_TIMED = 3  # steps whose time tells how many are possible


@dataclass(frozen=True)
class TrainedFor:
    """A network that was trained.

    Attributes:
        network: in evaluation mode.
        seconds: of one processor, for all steps; images were made before.
        steps: that it took.
    """

    network: Restoration
    seconds: float
    steps: int


def train_for(
    make: Callable[[], Restoration], optics: FixedOptics, limit: float, seed: int
) -> TrainedFor:
    """Train a network for so much process time as the camera experiment does, but for the lens.

    One without parameters is taken as it is.

    The seed decides its first weights, the order of the crops and the noise.  The learning rate
    falls to zero along a cosine, over as many steps as the time is enough for by the first ones.

    Args:
        make: the network.
        optics: images that it is trained on.
        limit: process time, seconds.
        seed: of all random numbers.
    """
    torch.manual_seed(seed)
    if not [*make().parameters()]:
        return TrainedFor(make().eval(), 0.0, 0)
    trial = _Training(make().train(), optics, seed)
    trial.step(0)
    seconds = sum(trial.step(number) for number in range(_TIMED)) / _TIMED
    steps = max(1, round(limit / seconds))
    torch.manual_seed(seed)
    training = _Training(make().train(), optics, seed)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(training.optimizer, T_max=steps)
    taken = 0.0
    for number in range(steps):
        taken += training.step(number)
        scheduler.step()
    return TrainedFor(training.network.eval(), taken, steps)


class _Training:
    """A network, its optimizer, and the images that it sees."""

    def __init__(self, network: Restoration, optics: FixedOptics, seed: int) -> None:
        self.network, self.optics, self.seed = network, optics, seed
        self.loss = RestorationLoss(perceptual="none")
        self.optimizer = torch.optim.Adam(network.parameters(), lr=_RATE, betas=_BETAS)
        self.generator = torch.Generator().manual_seed(seed)
        self.order: list[int] = []

    def step(self, number: int) -> float:
        """Take a step, and return its process time in seconds; noise and images do not count."""
        train = self.optics.splits["train"]
        chosen = torch.tensor([self._next() for _ in range(self.optics.batch)])
        truth = train.truth[chosen].float()
        raw = self.optics.raw(train.images[chosen], self.seed * 100_000 + number)
        started = time.process_time()
        found = self.network(raw.flatten(0, 1), self.optics.functions, None)
        found = found.unflatten(0, raw.shape[:2])
        truth = truth[:, None].expand_as(found)
        total = loss_over_views(self.loss, found, truth, _VIEW_NORM)["total"]
        self.optimizer.zero_grad()
        total.backward()
        self.optimizer.step()
        return time.process_time() - started

    def _next(self) -> int:
        # All crops before any comes again.
        if not self.order:
            count = len(self.optics.splits["train"].images)
            self.order = torch.randperm(count, generator=self.generator).tolist()
        return self.order.pop()


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
    noise = network.noise_arguments(optics.readout.noise)
    found = network(raw, optics.functions, None, *noise).clamp(0.0, 1.0)
    return found, split.truth[n].float().expand_as(found)
