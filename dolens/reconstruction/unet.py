"""The U-Net processes an image at several scales; images are padded to sides that allow it."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from dolens.errors import InputError


class UNet(nn.Module):
    """A `UNet` maps images to images, through `depth` halvings and as many doublings with skip
    connections.

    The network of the supplement's Figure 4: every stage is two 3×3 convolutions, each with
    batch normalisation and a ReLU.  Stage k works at 1/2ᵏ of the resolution with width·2ᵏ
    channels; max-pooling leads down; a bilinear ×2 and one 3×3 block lead up, which leaves no
    chequerboard as a transposed convolution does; a 1×1 convolution ends it.

    Args:
        in_channels: channels of the input.
        out_channels: channels of the output.
        width: channels of the first stage.
        depth: number of halvings.

    Rarely needed:
        zero_output: start with a last convolution of zeros, so that the output is zero and a
            residual network that adds it to its input begins as the identity.

    Raises:
        InputError: a number of channels, `width` or `depth` below 1, or a `depth` above 16.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        width: int = 16,
        depth: int = 3,
        zero_output: bool = False,
    ) -> None:
        super().__init__()
        sizes = {
            "in_channels": in_channels,
            "out_channels": out_channels,
            "width": width,
            "depth": depth,
        }
        for name, value in sizes.items():
            if value < 1:
                raise InputError(f"UNet {name}={value}: must be a whole number of at least 1")
        check_halvings("UNet depth", depth)
        self.depth = depth
        widths = [width * 2**stage for stage in range(depth + 1)]
        self.down = nn.ModuleList(
            _two_blocks(before, after)
            for before, after in zip([in_channels, *widths[:-1]], widths, strict=True)
        )
        climb = range(depth - 1, -1, -1)
        self.lift = nn.ModuleList(_block(widths[stage + 1], widths[stage]) for stage in climb)
        self.merge = nn.ModuleList(_two_blocks(2 * widths[stage], widths[stage]) for stage in climb)
        self.output = nn.Conv2d(width, out_channels, kernel_size=1)
        if zero_output:
            nn.init.zeros_(self.output.weight)
            nn.init.zeros_(self.output.bias)  # type: ignore[arg-type]  # it has one
        # Channels last is how convolutions run fastest: 0.7 of the time on a CPU.  The weights'
        # layout decides the layout of everything that flows through them.
        self.to(memory_format=torch.channels_last)

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, in_channels, H, W) to (B, out_channels, H, W), for any H and W.

        Sides that are no multiple of 2**depth are extended by repeating the last row or column
        and the result is cropped.
        """
        height, width = image.shape[-2:]
        # At least two cells a side: batch normalisation cannot train on a single value a
        # channel, which one small image would leave at the coarsest stage.
        features = pad_to_multiple(image, 2**self.depth, cells=2)
        skips: list[Tensor] = []
        for stage, block in enumerate(self.down):
            if stage > 0:
                features = functional.max_pool2d(features, kernel_size=2)
            features = block(features)
            skips.append(features)
        skips.pop()  # the coarsest stage is where the climb begins, not a skip
        for lift, merge in zip(self.lift, self.merge, strict=True):
            features = functional.interpolate(
                features, scale_factor=2, mode="bilinear", align_corners=False
            )
            features = merge(torch.cat([skips.pop(), lift(features)], dim=1))
        return self.output(features)[..., :height, :width]


def _block(before: int, after: int) -> nn.Sequential:
    # Batch normalisation subtracts the mean, so a bias in the convolution would do nothing.
    return nn.Sequential(
        nn.Conv2d(before, after, kernel_size=3, padding=1, bias=False),
        nn.BatchNorm2d(after),
        nn.ReLU(inplace=True),
    )


def _two_blocks(before: int, after: int) -> nn.Sequential:
    return nn.Sequential(*_block(before, after), *_block(after, after))


# They leave one pixel of a side of 65 536.
_MOST_HALVINGS = 16


def check_halvings(what: str, count: int) -> None:
    """Refuse more halvings than any photograph allows.

    Args:
        what: of which network, and its argument; the message begins with it.
        count: of halvings.

    Raises:
        InputError: more than 16.
    """
    if count > _MOST_HALVINGS:
        raise InputError(f"{what}={count}: must be a whole number of at most {_MOST_HALVINGS}")


def pad_to_multiple(image: Tensor, multiple: int, cells: int = 1) -> Tensor:
    """Extend (B, C, H, W) at the bottom and the right by repeating the last row and column.

    Each side becomes the smallest multiple of `multiple` that holds it and is at least
    `cells`·`multiple`.  An image that fits already is returned itself.
    """
    rows, columns = (
        max(cells, -(-length // multiple)) * multiple - length for length in image.shape[-2:]
    )
    if rows == 0 and columns == 0:
        return image
    return functional.pad(image, (0, columns, 0, rows), mode="replicate")
