"""Every pair of glasses of experiment=search_achromat as a cemented doublet, by plain NumPy.

    python scripts/lens_search/achromat_pairs.py [--best 20] [--forms RUN/forms.csv]

Each pair, in both orders, starts from its thin-lens achromat (powers V/(V₁ - V₂), Kidger ch. 9) in
three bendings.  Two curvatures, two thicknesses (2 to 12 mm) and the focus are fitted by damped
least squares with differences to the rays of 0, 0.7 and 1° at three wavelengths, f/6, stop at the
front; the third curvature holds the focal length.  All pairs are one batch of arrays.  The tracer
knows nothing of dolens, through which only the indices of the catalogue are read.  Printed are the
best pairs with their mean RMS spot (µm) and their secondary spectrum by the thin-lens formula
f·(P₁ - P₂)/(V₁ - V₂), and with `--forms` how the pairs of a search rank among them.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
F, STOP = 100.0, 100.0 / 12.0
ANGLES = np.radians([0.0, 0.7, 1.0])
NAMES = "N-*,F2,F5,LF5,LLF1,K7,K10,SF1,SF2,SF4,SF5,SF6,SF10,SF57,KZFS12"
WITHOUT = ["*HT*", "*Q2"]
THIN, THICK = 2.0, 12.0
ROUNDS, STEP = 40, 1e-6


def pupil(rings: int, arms: int) -> tuple[Array, Array]:
    """Return points (N, 2) of half of the unit disk and weights that sum to one."""
    node, share = np.polynomial.legendre.leggauss(rings)
    radius, angle = np.sqrt((node + 1) / 2), np.pi * (np.arange(arms) + 0.5) / arms
    points = np.stack([np.outer(radius, np.sin(angle)), np.outer(radius, np.cos(angle))], -1)
    return points.reshape(-1, 2), np.repeat(share / 2 / arms, arms)


def last_curvature(c: Array, t: Array, n: Array) -> Array:
    """Return the third curvature that gives the focal length, and the back focus.

    Args:
        c: (L, 2), the first two.
        t: (L, 2), thicknesses, mm.
        n: (L, 2), indices at the middle wavelength.
    """
    y = np.ones(len(c))
    nu = -y * c[:, 0] * (n[:, 0] - 1)
    y = y + t[:, 0] * nu / n[:, 0]
    nu = nu - y * c[:, 1] * (n[:, 1] - n[:, 0])
    y = y + t[:, 1] * nu / n[:, 1]
    # nu' = nu - y·c₃·(1 - n₂) is -1/f behind the lens.
    return np.stack([(nu + 1 / F) / (y * (1 - n[:, 1])), y * F], -1)


def residuals(v: Array, n: Array, rings: int, arms: int) -> Array:
    """Return ray positions about the centroid of their field, weighted, (L, R), mm.

    Args:
        v: (L, 5): two curvatures, two thicknesses, and the shift of the focus.
        n: (L, 2, 3), indices.
    """
    points, weight = pupil(rings, arms)
    c3, back = last_curvature(v[:, :2], v[:, 2:4], n[:, :, 1]).T
    curvatures = [v[:, 0], v[:, 1], c3]
    gaps = [v[:, 2], v[:, 3], back + v[:, 4]]
    shape = (len(v), len(ANGLES), 3, len(points))

    def spread(a: Array) -> Array:
        return np.broadcast_to(a.reshape(-1, 1, 1, 1), shape)

    x = np.broadcast_to(STOP * points[:, 0], shape)
    y = np.broadcast_to(STOP * points[:, 1], shape)
    z = np.zeros(shape)
    d = [np.zeros(shape)] + [
        np.broadcast_to(f(ANGLES)[None, :, None, None], shape) for f in (np.sin, np.cos)
    ]
    index = np.ones(shape)
    for place, (curvature, gap) in enumerate(zip(curvatures, gaps, strict=True)):
        c = spread(curvature)
        # The nearer point of the sphere c·(x² + y² + z²) = 2z.
        g = d[2] - c * (x * d[0] + y * d[1] + z * d[2])
        h = c * (x * x + y * y + z * z) - 2 * z
        length = h / (g + np.sqrt(np.maximum(g * g - c * h, 1e-12)))
        x, y, z = (p + length * q for p, q in zip((x, y, z), d, strict=True))
        normal = (-c * x, -c * y, 1 - c * z)
        after = np.ones(shape)
        if place < 2:
            after = np.broadcast_to(n[:, place, None, :, None], shape)
        ratio = index / after
        cosine = sum(p * q for p, q in zip(normal, d, strict=True))
        bend = np.sqrt(np.maximum(1 - ratio**2 * (1 - cosine**2), 1e-12)) - ratio * cosine
        d = [ratio * q + bend * p for p, q in zip(normal, d, strict=True)]
        index, z = after, z - spread(gap)
    x, y = x - z * d[0] / d[2], y - z * d[1] / d[2]
    y = y - (y * weight).sum(-1, keepdims=True).mean(2, keepdims=True)
    both = np.stack([x, y], -1) * np.sqrt(weight / 3)[:, None]
    return both.reshape(len(v), -1)


def fitted(v: Array, n: Array) -> Array:
    """Return the lenses after damped least squares."""
    damping = np.full(len(v), 1e-3)
    scale = np.array([1e-2, 1e-2, 1.0, 1.0, 1e-1])
    r = residuals(v, n, 3, 4)
    for _ in range(ROUNDS):
        columns = []
        for k in range(5):
            moved = v.copy()
            moved[:, k] += STEP * scale[k]
            columns.append((residuals(moved, n, 3, 4) - r) / STEP)
        jacobian = np.stack(columns, -1)
        square = np.einsum("lrp,lrq->lpq", jacobian, jacobian)
        trace = np.einsum("lpp->lp", square)
        square = square + (damping[:, None] * trace + 1e-18)[..., None] * np.eye(5)
        gradient = np.einsum("lrp,lr->lp", jacobian, r)
        step = -np.linalg.solve(square, gradient[..., None])[..., 0] * scale
        tried = v + step
        tried[:, 2:4] = tried[:, 2:4].clip(THIN, THICK)
        there = residuals(tried, n, 3, 4)
        better = (there**2).sum(1) < (r**2).sum(1)
        v, r = np.where(better[:, None], tried, v), np.where(better[:, None], there, r)
        damping = np.where(better, damping / 4, damping * 6).clip(1e-9, 1e6)
    return v


def spots(v: Array, n: Array) -> Array:
    """Return the mean of the RMS spots over the fields, µm, (L,)."""
    r = residuals(v, n, 8, 8).reshape(len(v), len(ANGLES), -1)
    return 1e3 * np.sqrt((r**2).sum(-1)).mean(-1)


def main() -> None:
    """Fit all pairs and print the best."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--best", type=int, default=20)
    parser.add_argument("--forms", type=Path, help="forms.csv of a search")
    arguments = parser.parse_args()
    names, index = _glasses()
    v_number = (index[:, 1] - 1) / (index[:, 2] - index[:, 0])
    partial = (index[:, 2] - index[:, 1]) / (index[:, 2] - index[:, 0])
    first, second = (a.ravel() for a in np.indices((len(names),) * 2))
    apart = np.abs(v_number[first] - v_number[second]) > 8.0
    first, second = first[apart], second[apart]
    found = []
    for part in np.array_split(np.arange(len(first)), max(1, len(first) // 400)):
        one, two = first[part], second[part]
        n = np.stack([index[one], index[two]], 1)
        power = v_number[one] / (v_number[one] - v_number[two]) / F
        difference = power / (n[:, 0, 1] - 1)  # c₁ - c₂
        merit = np.full(len(part), np.inf)
        for front in (0.4, 1.0, 1.8):
            c1 = np.full(len(part), front / F)
            start = np.stack([c1, c1 - difference], -1)
            start = np.concatenate([start, np.tile([5.0, 5.0, 0.0], (len(part), 1))], 1)
            merit = np.fmin(merit, spots(fitted(start, n), n))
        found.append(merit)
    merit = np.concatenate(found)
    order = np.argsort(merit)
    print(f"{len(names)} glasses, {len(merit)} doublets; the best of each pair:")
    print("| pair | RMS spot, µm | thin-lens secondary spectrum, µm |\n|---|---|---|")
    ranks: dict[tuple[str, str], int] = {}
    for at in order:
        pair = (names[first[at]], names[second[at]])
        ranks.setdefault(pair, len(ranks) + 1)
        if len(ranks) <= arguments.best:
            slope = partial[first[at]] - partial[second[at]]
            secondary = -1e3 * F * slope / (v_number[first[at]] - v_number[second[at]])
            print(f"| {' + '.join(pair)} | {merit[at]:.3f} | {secondary:.1f} |")
    if arguments.forms:
        by_pair = {(names[first[at]], names[second[at]]): merit[at] for at in order}
        print("\n| form | pair | the search, µm | here, µm | rank here |\n|---|---|---|---|---|")
        for row in csv.DictReader(arguments.forms.open(newline="", encoding="utf-8")):
            pair = tuple(part.split(":")[1] for part in row["glasses"].split(", "))
            ours, here = float(row["mean_rms_spot_um"]), by_pair.get(pair, np.nan)
            print(
                f"| {row['form']} | {' + '.join(pair)} | {ours:.3f} | {here:.3f} | {ranks[pair]} |"
            )


def _glasses() -> tuple[list[str], Array]:
    """Return the names (K) of the experiment's glasses and their indices at C, d and F, (K, 3)."""
    from dolens.lens_search.glass.choice import GlassChoice, chosen_glasses

    choice = GlassChoice(("SCHOTT",), tuple(NAMES.split(",")), tuple(WITHOUT))
    found = chosen_glasses(choice, (656.2725, 587.5618, 486.1327))
    return [name.split(":")[1] for name in found.names], found.indices.numpy()


if __name__ == "__main__":
    main()
