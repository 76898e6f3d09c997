"""A network halves images several times: they are padded to sides that allow it."""

from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError

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
