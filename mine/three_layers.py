"""A small network."""

from torch import Tensor, nn


class ThreeLayers(nn.Module):
    """Adds what three convolutions give to an image.

    Args:
        width: channels between them.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, width, 5, padding=2),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, 3, 3, padding=1),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Return the restored image."""
        return image + self.layers(image)
