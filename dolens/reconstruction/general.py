"""One network restores the images of any lens: it is told how the lens blurs and how the sensor is
noisy.

Wiener's filter undoes what is known of the blur (`solve_in_opponent_colours`), three times over:
weakly, as is best for the filter alone, and strongly.  A transform makes the noise behind it alike
in dark and bright parts.  A network that was trained with many lenses, at many levels of light,
removes what is left.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from dolens.errors import InputError, one_line
from dolens.reconstruction.likelihood import depth_probabilities, picture_weights
from dolens.reconstruction.nafnet import NAFNet
from dolens.reconstruction.opponent_wiener import (
    OPPONENT,
    colour_filters,
    correlations,
    functions_of_each,
    over_depths,
    solve_in_opponent_colours,
)
from dolens.reconstruction.restoration import COLORS, Restoration
from dolens.reconstruction.untrained import REFERENCE_VARIANCE
from dolens.reconstruction.wiener import (
    LEAST_SHOT,
    MEAN_LIGHT,
    close_periodically,
    padded_lengths,
    readouts_of,
    squared_frequency,
    transfer_function,
)
from dolens.sensor.colour import linear_to_srgb

# Noise over signal power, as those of `UntrainedRestoration`, of the three filters.
_RATIOS = ((0.1, 0.7, 2.0), (0.4, 2.8, 8.0), (1.6, 11.2, 32.0))
_MIDDLE = 1
# Frequencies, over Nyquist's, between which transfer and noise are averaged for the network.
_BANDS = (0.0, 0.125, 0.25, 0.375, 0.5, 0.75, 1.0)
# Pixels of the grid that they are taken on, whatever the size of the image.
_GRID = 128
IMAGES = COLORS * (1 + len(_RATIOS))
KNOWN = 3 + (len(_BANDS) - 1) * (2 * len(_RATIOS) + 1)
# The trained weights of the default widths, in half precision; docs/general_restorer.md tells how
# they were made.
WEIGHTS = Path(__file__).with_suffix(".pt")


class Stabiliser(NamedTuple):
    """A `Stabiliser` maps light to values whose noise is even, and back.

        y = (√(x + c) - √c)/(√(1 + c) - √c)

    With shot noise a·x and read noise b the constant is c = b/a + 3a/8; black stays 0 and white 1.

    Attributes:
        pedestal: c, of each image, (B,).
    """

    pedestal: Tensor

    def forward(self, light: Tensor) -> Tensor:
        """Return y of (B, ..., H, W)."""
        c = self._like(light)
        return ((light + c).clamp(min=0.0).sqrt() - c.sqrt()) / self._span(c)

    def inverse(self, values: Tensor) -> Tensor:
        """Return x of (B, ..., H, W); of less than black, what its mirror image has below zero."""
        c = self._like(values)
        root = values * self._span(c) + c.sqrt()
        return root * root.abs() - c

    def _like(self, images: Tensor) -> Tensor:
        return self.pedestal.to(images).reshape(-1, *[1] * (images.ndim - 1))

    @staticmethod
    def _span(c: Tensor) -> Tensor:
        # √(1 + c) - √c without cancellation where c is large.
        return 1.0 / ((1.0 + c).sqrt() + c.sqrt())


class Prepared(NamedTuple):
    """A `Prepared` holds the input of the network of a `GeneralRestoration`.

    Attributes:
        images: stabilised: the sensor's, then those of the three filters, (B, 12, H, W).
        known: of blur and noise, (B, KNOWN); see `prepared`.
        pedestal: of the `Stabiliser`, (B,).
    """

    images: Tensor
    known: Tensor
    pedestal: Tensor


def prepared(raw: Tensor, functions: Tensor, noise: Tensor) -> Prepared:
    """Return what the network is given of images of one camera.

    Of several readouts it is given the filters of least squares over all of them, and their mean.

    Beside the images it is told the logarithms of the noise's deviation and of the pedestal, the
    number of functions, and in bands of frequency for each filter W the luminance's mean transfer
    Re⟨W·H⟩ and the noise's density, and the deviation of the middle one's transfer over depths.

    Args:
        raw: linear light, (B, 3, H, W), or of N readouts (B, N, 3, H, W).
        functions: point spread functions of D depths, (D, 3, K, K), K odd, or (N, D, 3, K, K).
        noise: variance at light x is noise[0]·x + noise[1], (2,), or (N, 2).

    Raises:
        InputError: functions of another shape, or of another number of readouts.
    """
    functions_of_each(raw[:1], functions)
    readouts = readouts_of(raw, functions, noise)
    height, width = raw.shape[-2:]
    rows, columns = padded_lengths(height, width, functions.shape[-1] // 2, functions.shape[-1])
    matched, power = correlations(readouts.functions, rows, columns)
    spectrum = torch.fft.rfft2(close_periodically(readouts.images, rows, columns))
    solved = solve_in_opponent_colours(
        power.sum(dim=0),
        squared_frequency(rows, columns, raw),
        noise_to_signal(readouts.noise),
        (matched * spectrum).sum(dim=1)[:, None],
    )
    light = torch.fft.irfft2(solved, s=(rows, columns))[..., :height, :width]
    return given_to_the_network(readouts.mean, light, readouts.functions, readouts.noise)


def noise_to_signal(noise: Tensor) -> Tensor:
    """Return the ratios of the three filters in opponent colours, (3, 3), at a noise (2,)."""
    shot, read = noise.unbind()
    variance = MEAN_LIGHT * shot.clamp(min=LEAST_SHOT) + read
    return noise.new_tensor(_RATIOS) * variance / REFERENCE_VARIANCE


def given_to_the_network(raw: Tensor, light: Tensor, functions: Tensor, noise: Tensor) -> Prepared:
    """Return what the network is given where the filters' images (B, 3, 3, H, W) are known.

    The others are of `Readouts`: the mean (B, 3, H, W), functions (N, D, 3, K, K) and the noise.
    """
    ratios = noise_to_signal(noise.to(raw))
    shot, read = noise.to(raw).unbind()
    shot = shot.clamp(min=LEAST_SHOT)
    pedestal = read / shot + 0.375 * shot
    # Not len(raw), by which torch.export would fix the number of images.
    pedestals = pedestal.expand(raw.shape[0])
    images = stabilised_images(raw, light, pedestals)
    # Of one unit of light y's noise has this deviation where shot noise rules.
    deviation = 0.5 * shot.sqrt() * ((1.0 + pedestal).sqrt() + pedestal.sqrt())
    several = raw.new_tensor(float(functions.shape[1] > 1))
    known = torch.stack([deviation.log10(), pedestal.log10(), several])
    known = torch.cat([known, _known_in_bands(functions.to(raw), ratios, deviation)])
    return Prepared(images, known.expand(raw.shape[0], -1), pedestals)


def stabilised_images(raw: Tensor, light: Tensor, pedestals: Tensor) -> Tensor:
    """Return the images of a `Prepared`, of the sensor's and the filters' in linear light."""
    return Stabiliser(pedestals).forward(torch.cat([raw[:, None], light], dim=1)).flatten(1, 2)


def _known_in_bands(functions: Tensor, ratios: Tensor, deviation: Tensor) -> Tensor:
    """Return means over the bands: transfers of M filters, the middle one's deviation, and
    logarithms of the noise's densities, (6·(2M + 1),).
    """
    side = max(_GRID, functions.shape[-1] + functions.shape[-1] % 2)
    transfer = transfer_function(functions, side, side)
    matched, power = over_depths(transfer)
    power = power.sum(dim=0)
    filters = colour_filters(
        power.expand(len(ratios), *power.shape), torch.ones_like(matched[:1]), ratios, side
    )
    grey = torch.tensor(OPPONENT[0]).to(functions)
    # From colour j of readout n to the luminance of filter m.
    rows = torch.einsum("i,mijuv,njuv->mnjuv", grey.to(filters), filters, matched)
    passed = torch.einsum("mnjuv,ndjuv,j->dmuv", rows, transfer, grey.to(rows)).real
    noise = rows.abs().square().sum(dim=(1, 2))
    radius = squared_frequency(side, side, functions).sqrt()
    bands = []
    for low, high in pairwise(_BANDS):
        inside = ((radius >= low) & (radius < high)).to(functions)
        bands.append(inside / inside.sum())
    mean = torch.stack(bands).flatten(1)
    spread = passed[:, _MIDDLE].std(dim=0, correction=0)
    density = noise.flatten(1) @ mean.T * deviation**2
    return torch.cat(
        [
            (passed.mean(dim=0).flatten(1) @ mean.T).flatten(),
            spread.flatten() @ mean.T,
            density.clamp(min=1e-12).log10().flatten(),
        ]
    )


def prepared_with(raw: Tensor, functions: Tensor, noise: Tensor) -> Prepared:
    """Return what the network is given of images with functions (D, 3, K, K) of all of them, or
    (B, D, 3, K, K), of each its own; of readouts as `functions_of_each` has them.
    """
    if functions.ndim == raw.ndim:
        return prepared(raw, functions, noise)
    pairs = zip(raw.split(1), functions_of_each(raw, functions), strict=True)
    parts = [prepared(image, own, noise) for image, own in pairs]
    return Prepared(*(torch.cat(part) for part in zip(*parts, strict=True)))


class GeneralRestoration(Restoration):
    """Restore images of any lens by a network that has been told the lens and the noise.

        restored = sRGB(y⁻¹(y_middle + network(y of all images, what is known)))

    y is the `Stabiliser`'s, y_middle the image of the middle filter.

    With `by_depth` and several functions it restores with each alone besides, and the likelihood of
    the data chooses among the pictures at each place; see `depth_probabilities`.  That takes as
    many times longer as there are functions, and one more.

    Args:
        weights: "package" for those that dolens brings, "none" to begin at random, or the path of a
            file that `save_weights` has written.
        by_depth: whether functions are those of depths that places of an image may have.
        held: whether the weights stay as they are, while a lens is learned through them.

    Rarely needed, as the trained weights are of these widths:
        width: channels of the NAFNet's first stage.
        down: blocks of each stage on the way down.
        middle: blocks at the coarsest stage.
        up: blocks of each stage on the way up.

    Raises:
        InputError: a number out of range, a file that holds no weights of these widths, or none
            that are held.
    """

    needs_point_spread_function: ClassVar[bool] = True
    needs_noise: ClassVar[bool] = True
    takes_functions_of_images: ClassVar[bool] = True
    takes_readouts: ClassVar[bool] = True

    def __init__(
        self,
        weights: str = "package",
        by_depth: bool = False,
        held: bool = False,
        width: int = 32,
        down: Sequence[int] = (2, 2, 2),
        middle: int = 3,
        up: Sequence[int] = (2, 2, 2),
    ) -> None:
        super().__init__()
        if held and weights == "none":
            raise InputError("network.held: true; allowed with network.weights=none: false")
        self.network = NAFNet(
            IMAGES,
            COLORS,
            width,
            down,
            middle,
            up,
            channel_attention=False,
            zero_output=True,
        )
        self.knowledge = nn.Sequential(nn.Linear(KNOWN, 64), nn.GELU(), nn.Linear(64, width))
        self.by_depth = by_depth
        self.pretrained = self.restores_already = weights != "none"
        if self.pretrained:
            self.load_weights(WEIGHTS if weights == "package" else Path(weights))
        self.requires_grad_(not held)

    def load_weights(self, file: Path) -> None:
        """Take the weights of a file, which is read as data.

        Raises:
            InputError: it is missing, no file of weights, or of other widths.
        """
        try:
            found = torch.load(file, map_location="cpu", weights_only=True)
            self.load_state_dict({name: value.float() for name, value in found.items()})
        except FileNotFoundError:
            raise InputError(f"network.weights: {file} does not exist") from None
        except Exception as error:
            # Torch raises errors of many kinds for a file that is something else.
            raise InputError(
                f"network.weights: {file} holds no weights of this network: {one_line(error)}"
            ) from error

    def save_weights(self, file: Path) -> None:
        """Write the weights in half precision, whose rounding is far below the noise."""
        torch.save({name: value.half() for name, value in self.state_dict().items()}, file)

    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; see `Restoration.forward`.

        Raises:
            InputError: `point_spread_functions` or `noise` is None, or of another shape.
        """
        functions, noise = self.functions_and_noise(point_spread_functions, noise)
        raw = raw.to(self.dtype)
        common = self.restored(prepared_with(raw, functions, noise))
        if not self.by_depth or functions.shape[-4] == 1:
            return common
        own = [self.restored(prepared_with(raw, f, noise)) for f in functions.split(1, dim=-4)]
        pairs = zip(raw.split(1), functions_of_each(raw, functions), strict=True)
        depths = torch.cat([depth_probabilities(image, f, noise) for image, f in pairs])
        pictures = torch.stack([*own, common], dim=1)
        return (picture_weights(depths)[:, :, None] * pictures).sum(dim=1)

    def restored(self, given: Prepared) -> Tensor:
        """Return the picture (B, 3, H, W), sRGB-encoded, of what is prepared."""
        start = given.images[:, COLORS * (1 + _MIDDLE) : COLORS * (2 + _MIDDLE)]
        change = self.network(given.images, self.knowledge(given.known)[:, :, None, None])
        stabilised = start + change.to(start.dtype)
        return _encoded(Stabiliser(given.pedestal).inverse(stabilised))


def _encoded(light: Tensor) -> Tensor:
    """Return sRGB values that go on straight below 0 and above 1, where clamping has no slope."""
    below, above = light.clamp(max=0.0), (light - 1.0).clamp(min=0.0)
    return linear_to_srgb(light) + 12.92 * below + 1.055 / 2.4 * above
