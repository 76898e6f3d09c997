"""Images are padded to sides that a network can halve several times."""

from torch import Tensor
from torch.nn import functional


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
