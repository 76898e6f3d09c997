"""Derivatives of images by autograd beside differences, as a table.

    python scripts/gradients.py                       # all lenses, by rays: tens of minutes
    python scripts/gradients.py --lens cooke_near --renderer psf --rays 20
    python scripts/gradients.py --experiment          # the experiments' own training losses

Each row is the derivative of a loss with respect to one parameter, in units of its scale, by
autograd and by central differences of the same loss with the same random samples, and the standard
error of their difference over the seeds.
"""

import argparse
import statistics
from collections.abc import Iterator

import torch
from benchmarks.gradient_cases import CASES, RENDERERS, image_loss, names_of
from benchmarks.training_losses import training_losses

from dolens.optics.lens import Lens
from dolens.rendering.gradient_check import GradientRow, Loss, gradient_rows


def main() -> None:
    """Print the table, and how many rows agree."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lens", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--renderer", nargs="*", default=["rays"], choices=list(RENDERERS))
    parser.add_argument("--rays", type=int, default=24, help="strata along a side of the pupil")
    parser.add_argument("--pixels", type=int, default=24)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--share", type=float, default=0.02, help="what counts as agreement")
    parser.add_argument("--experiment", action="store_true", help="training losses of experiments")
    parser.add_argument(
        "--step",
        type=float,
        help="of the differences, in units of the scale (1e-5 where no edge cuts the light); "
        "default: one that changes the loss by some thousandths",
    )
    options = parser.parse_args()
    torch.manual_seed(0)
    if options.experiment:
        for title, lens, loss, names in training_losses():
            # The plate's lens and the doublet's windows are clipped by their stops alone.
            rows = gradient_rows(loss, lens, names, range(options.seeds), options.step or 1e-5)
            report(title, rows, options.share)
        return
    for title, lens, loss, names, other in cases(options):
        rows = gradient_rows(loss, lens, names, range(options.seeds), options.step, other)
        report(title, rows, options.share)


def cases(
    options: argparse.Namespace,
) -> Iterator[tuple[str, Lens, Loss, list[str], Loss | None]]:
    """Every lens by every renderer that was asked for.

    A plan of `auto` holds its disc in the pupil until it is looked at again, so its derivatives are
    compared with differences of renders by rays.
    """
    for name in options.lens:
        case = CASES[name]
        lens = case.lens()
        for renderer in options.renderer:
            loss = image_loss(case, lens, renderer, options.pixels, options.rays)
            rays = None
            if renderer == "auto":
                rays = image_loss(case, lens, "rays", options.pixels, options.rays)
            yield f"{name}, {renderer}", lens, loss, names_of(lens), rays


def report(title: str, rows: list[GradientRow], share: float) -> None:
    """A table, and a line that sums it up."""
    print(f"\n{title}")
    print(f"{'parameter':32s} {'autograd':>12s} {'difference':>12s} {'noise':>9s} {'error':>7s}")
    for row in rows:
        mark = "" if row.agrees(share) else "  *"
        print(
            f"{row.name:32s} {row.autograd:+12.4e} {row.difference:+12.4e} {row.noise:9.1e} "
            f"{100 * row.error:6.2f}%{mark}"
        )
    good = sum(row.agrees(share) for row in rows)
    first = torch.tensor([row.autograd for row in rows], dtype=torch.float64)
    second = torch.tensor([row.difference for row in rows], dtype=torch.float64)
    cosine = float(torch.cosine_similarity(first, second, dim=0))
    print(
        f"{good} of {len(rows)} agree within {100 * share:g} % or three standard errors; median "
        f"error {100 * statistics.median(row.error for row in rows):.2f} %; cosine {cosine:.6f}, "
        f"norm ratio {float(first.norm() / second.norm()):.4f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
