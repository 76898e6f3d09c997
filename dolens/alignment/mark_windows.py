"""Windows of photographs show a chart's marks, one each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.alignment.blur import blurred
from dolens.alignment.gaussian_derivatives import weights_on_grid
from dolens.errors import InputError

# A mark is looked for in a window that is blurred by so many pixels, and its centroid taken where
# it is at least so bright beside its peak.
_BLUR, _BRIGHT = 2.0, 0.3
# A weight reaches so many of its widths.
_REACH = 4.5
# A peak below so many standard deviations of the blurred noise is none.
_FAINT = 8.0


@dataclass(frozen=True)
class WeightedSums:
    """Holds sums of counts with K weights for each of D marks in N photographs.

    Attributes:
        counts: (N, D, K), electrons.
        background: (N, D, K), the sums of a background of one electron a pixel.
        products: (N, D, K, K), Σ D_k·D_l over pixels: of read noise of one electron.
        width: (N, D), σ, mm.
        centre: (N, D, 2), mm on the sensor.
    """

    counts: Tensor
    background: Tensor
    products: Tensor
    width: Tensor
    centre: Tensor


@dataclass(frozen=True)
class MarkWindows:
    """Holds the pixels about each of D marks in N photographs by one sensor.

    Attributes:
        counts: (N, D, H, W), electrons, the dark level taken off.
        x: (N, D, W), mm on the sensor, the middles of columns.
        y: (N, D, H), of rows.
        pitch: of pixels, mm.
        read_noise: RMS of a pixel, electrons.
    """

    counts: Tensor
    x: Tensor
    y: Tensor
    pitch: float
    read_noise: float

    def chosen(self, photographs: Sequence[int]) -> "MarkWindows":
        """Return some of the photographs, by their numbers from 0."""
        at = list(photographs)
        return replace(self, counts=self.counts[at], x=self.x[at], y=self.y[at])

    def located(self) -> Tensor:
        """Return the marks' centroids (N, D, 2), mm, right to about a pixel.

        Raises:
            InputError: a window shows no mark.
        """
        level = self.counts.flatten(2).median(-1).values
        smooth = blurred(self.counts - level[..., None, None], _BLUR)
        peak = smooth.amax((-2, -1))
        # A Gaussian of b pixels leaves noise 1/(2√π·b) of its deviation.
        noise = (level.clamp(min=0.0) + self.read_noise**2).sqrt() / (3.545 * _BLUR)
        faint = peak < _FAINT * noise
        if bool(faint.any()):
            photograph, mark = (int(i) + 1 for i in torch.nonzero(faint)[0])
            raise InputError(
                f"search_radius: photograph {photograph} shows no mark {mark} where one is; "
                "allowed: windows that hold each mark, see chart and planes"
            )
        light = torch.where(smooth > _BRIGHT * peak[..., None, None], smooth, 0.0)
        total = light.sum((-2, -1))
        x = (light.sum(-2) * self.x).sum(-1) / total
        y = (light.sum(-1) * self.y).sum(-1) / total
        return torch.stack([x, y], -1)

    def sums(self, centre: Tensor, width: Tensor, highest: int) -> WeightedSums:
        """Return sums of the counts with derivatives of Gaussians, see `gaussian_derivatives`.

        Args:
            centre: (N, D, 2), of the Gaussians, mm on the sensor.
            width: (N, D), mm.
            highest: order of the derivatives.

        Raises:
            InputError: a Gaussian reaches beyond its window.
        """
        for middles, about in ((self.x, centre[..., 0]), (self.y, centre[..., 1])):
            room = torch.minimum(about - middles.amin(-1), middles.amax(-1) - about)
            if bool((room < _REACH * width).any()):
                need = float((_REACH * width - room).max())
                raise InputError(
                    f"search_radius: a mark lies {need:.3g} mm too near its window's edge"
                )
        x, y = self.x - centre[..., :1], self.y - centre[..., 1:]
        along, down = weights_on_grid(x, y, width, highest)
        counts = ((down @ self.counts) * along).sum(-1)
        products = (along @ along.mT) * (down @ down.mT)
        return WeightedSums(counts, along.sum(-1) * down.sum(-1), products, width, centre)
