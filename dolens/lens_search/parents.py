"""The best forms of a search are taken to lead to others."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import Designs

Pool = dict[Arrangement, Designs]


def best_forms(pool: Pool, count: int) -> list[Designs]:
    """Return that many of the best forms of all arrangements, one each."""
    ranked = list(_ranked(pool))[:count]
    return [pool[arrangement].chosen(torch.tensor([row])) for arrangement, row in ranked]


def parents_of(pool: Pool, count: int, tried: dict[Arrangement, Tensor]) -> list[Designs]:
    """Return the best forms of all arrangements that have not been parents yet, and note them.

    Args:
        pool: all forms.
        count: of parents.
        tried: u of those that have been parents.
    """
    rows: dict[Arrangement, list[int]] = {}
    left = count
    for arrangement, row in _ranked(pool):
        if arrangement.within:  # elements around a stop in glass cannot be taken apart
            continue
        values = pool[arrangement].values[row]
        before = tried.get(arrangement)
        if before is not None and bool((before - values).abs().amax(-1).lt(1e-3).any()):
            continue
        rows.setdefault(arrangement, []).append(row)
        left -= 1
        if left == 0:
            break
    found = []
    for arrangement, chosen in rows.items():
        designs = pool[arrangement].chosen(torch.tensor(chosen))
        before = tried.get(arrangement)
        tried[arrangement] = (
            designs.values if before is None else torch.cat([before, designs.values])
        )
        found.append(designs)
    return found


def shares(designs: Designs, size: int = 4) -> Sequence[Designs]:
    """Return designs in parts, a task each."""
    rows = torch.arange(len(designs.values))
    return [designs.chosen(part) for part in rows.split(size)]


def _ranked(pool: Pool) -> Iterator[tuple[Arrangement, int]]:
    """Yield the arrangement and the row of each form, the best first."""
    ranked = sorted(
        (float(merit), arrangement.stop, arrangement.within, row, arrangement)
        for arrangement, designs in pool.items()
        for row, merit in enumerate(designs.merit)
    )
    for *_, row, arrangement in ranked:
        yield arrangement, row
