"""Standard nonlinear least-squares problems, as functions of PyTorch in double precision.

Certified: NIST's Statistical Reference Datasets (StRD), nonlinear regression, with the parameters
and residual sums of squares that NIST certifies to eleven digits, from both of NIST's starts.
Moré: J. J. Moré, B. S. Garbow and K. E. Hillstrom, Testing Unconstrained Optimization Software, ACM
Trans. Math. Softw. 7 (1981), with the paper's starts and minima.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Problem(NamedTuple):
    """Residuals of variables, where to start, and the sums of squares at the known minima."""

    residuals: Callable[[Tensor], Tensor]
    starts: tuple[tuple[float, ...], ...]
    minima: tuple[float, ...]
    solution: tuple[float, ...] = ()


def _numbers(text: str) -> Tensor:
    return torch.tensor([float(word) for word in text.split()], dtype=torch.float64)


def _fit(model: Callable[[Tensor, Tensor], Tensor], x: Tensor, y: Tensor):
    return lambda b: y - model(b, x)


MISRA_X = _numbers(
    "77.6 114.9 141.1 190.8 239.9 289.0 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760.0"
)
MISRA_Y = _numbers(
    "10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.40 75.47 81.78"
)
BOX_X, BOX_Y = _numbers("1 2 3 5 7 10"), _numbers("109 149 149 191 213 224")
DAN_X = _numbers("1.309 1.471 1.490 1.565 1.611 1.680")
DAN_Y = _numbers("2.138 3.421 3.597 4.340 4.882 5.660")
RAT_X = _numbers("9 14 21 28 42 57 63 70 79")
RAT_Y = _numbers("8.930 10.800 18.590 22.330 39.350 56.110 61.730 64.620 67.080")
ONION_Y = _numbers(
    "16.08 33.83 65.80 97.20 191.55 326.20 386.87 520.53 590.03 651.92 724.93 699.56 689.96 "
    "637.56 717.41"
)
OSBORNE_Y = _numbers(
    ".844 .908 .932 .936 .925 .908 .881 .850 .818 .784 .751 .718 .685 .658 .628 .603 .580 .558 "
    ".538 .522 .506 .490 .478 .467 .457 .448 .438 .431 .424 .420 .414 .411 .406"
)
KOWALIK_X = _numbers("4 2 1 .5 .25 .167 .125 .1 .0833 .0714 .0625")
KOWALIK_Y = _numbers(".1957 .1947 .1735 .1600 .0844 .0627 .0456 .0342 .0323 .0235 .0246")
MEYER_Y = _numbers(
    "34780 28610 23650 19630 16370 13720 11540 9744 8261 7030 6005 5147 4427 3820 3307 2872"
)
BARD_Y = _numbers("0.14 0.18 0.22 0.25 0.29 0.32 0.35 0.39 0.37 0.58 0.73 0.96 1.34 2.10 4.39")

CERTIFIED = {
    "Misra1a": Problem(
        _fit(lambda b, x: b[0] * (1.0 - torch.exp(-b[1] * x)), MISRA_X, MISRA_Y),
        ((500.0, 1e-4), (250.0, 5e-4)),
        (1.2455138894e-01,),
        (2.3894212918e02, 5.5015643181e-04),
    ),
    "BoxBOD": Problem(
        _fit(lambda b, x: b[0] * (1.0 - torch.exp(-b[1] * x)), BOX_X, BOX_Y),
        ((1.0, 1.0), (100.0, 0.75)),
        (1.1680088766e03,),
        (2.1380940889e02, 5.4723748542e-01),
    ),
    "DanWood": Problem(
        _fit(lambda b, x: b[0] * x ** b[1], DAN_X, DAN_Y),
        ((1.0, 5.0), (0.7, 4.0)),
        (4.3173084083e-03,),
        (7.6886226176e-01, 3.8604055871e00),
    ),
    "Rat42": Problem(
        _fit(lambda b, x: b[0] / (1.0 + torch.exp(b[1] - b[2] * x)), RAT_X, RAT_Y),
        ((100.0, 1.0, 0.1), (75.0, 2.5, 0.07)),
        (8.0565229338e00,),
        (7.2462237576e01, 2.6180768402e00, 6.7359200066e-02),
    ),
    "Rat43": Problem(
        _fit(
            lambda b, x: b[0] / (1.0 + torch.exp(b[1] - b[2] * x)) ** (1.0 / b[3]),
            torch.arange(1.0, 16.0, dtype=torch.float64),
            ONION_Y,
        ),
        ((100.0, 10.0, 1.0, 1.0), (700.0, 5.0, 0.75, 1.3)),
        (8.7864049080e03,),
        (6.9964151270e02, 5.2771253025e00, 7.5962938329e-01, 1.2792483859e00),
    ),
    "MGH09": Problem(
        _fit(
            lambda b, x: b[0] * (x * x + x * b[1]) / (x * x + x * b[2] + b[3]), KOWALIK_X, KOWALIK_Y
        ),
        ((25.0, 39.0, 41.5, 39.0), (0.25, 0.39, 0.415, 0.39)),
        (3.0750560385e-04,),
        (1.9280693458e-01, 1.9128232873e-01, 1.2305650693e-01, 1.3606233068e-01),
    ),
    "MGH10": Problem(
        _fit(
            lambda b, x: b[0] * torch.exp(b[1] / (x + b[2])),
            torch.arange(50.0, 130.0, 5.0, dtype=torch.float64),
            MEYER_Y,
        ),
        ((2.0, 400000.0, 25000.0), (0.02, 4000.0, 250.0)),
        (8.7945855171e01,),
        (5.6096364710e-03, 6.1813463463e03, 3.4522363462e02),
    ),
    "MGH17": Problem(
        _fit(
            lambda b, x: b[0] + b[1] * torch.exp(-x * b[3]) + b[2] * torch.exp(-x * b[4]),
            10.0 * torch.arange(33, dtype=torch.float64),
            OSBORNE_Y,
        ),
        ((50.0, 150.0, -100.0, 1.0, 2.0), (0.5, 1.5, -1.0, 0.01, 0.02)),
        (5.4648946975e-05,),
        (
            3.7541005211e-01,
            1.9358469127e00,
            -1.4646871366e00,
            1.2867534640e-02,
            2.2122699662e-02,
        ),
    ),
}


def _helical_valley(u: Tensor) -> Tensor:
    x, y, z = u
    turn = torch.atan2(y, x) / (2.0 * math.pi)
    turn = torch.where(turn < -0.25, turn + 1.0, turn)
    return torch.stack([10.0 * (z - 10.0 * turn), 10.0 * (torch.hypot(x, y) - 1.0), z])


def _bard(u: Tensor) -> Tensor:
    i = torch.arange(1.0, 16.0, dtype=u.dtype)
    return BARD_Y - (u[0] + i / ((16.0 - i) * u[1] + torch.minimum(i, 16.0 - i) * u[2]))


def _box(u: Tensor) -> Tensor:
    t = 0.1 * torch.arange(1.0, 11.0, dtype=u.dtype)
    return (
        torch.exp(-t * u[0]) - torch.exp(-t * u[1]) - u[2] * (torch.exp(-t) - torch.exp(-10.0 * t))
    )


def _powell_singular(u: Tensor) -> Tensor:
    a, b, c, d = u
    return torch.stack(
        [
            a + 10.0 * b,
            math.sqrt(5.0) * (c - d),
            (b - 2.0 * c) ** 2,
            math.sqrt(10.0) * (a - d) ** 2,
        ]
    )


def _wood(u: Tensor) -> Tensor:
    a, b, c, d = u
    return torch.stack(
        [
            10.0 * (b - a * a),
            1.0 - a,
            math.sqrt(90.0) * (d - c * c),
            1.0 - c,
            math.sqrt(10.0) * (b + d - 2.0),
            (b - d) / math.sqrt(10.0),
        ]
    )


def _brown_dennis(u: Tensor) -> Tensor:
    t = 0.2 * torch.arange(1.0, 21.0, dtype=u.dtype)
    return (u[0] + t * u[1] - t.exp()) ** 2 + (u[2] + u[3] * t.sin() - t.cos()) ** 2


def _watson(u: Tensor) -> Tensor:
    t = torch.arange(1.0, 30.0, dtype=u.dtype)[:, None] / 29.0
    j = torch.arange(float(len(u)), dtype=u.dtype)
    value = (u * t**j).sum(1)
    slope = (j[1:] * u[1:] * t ** (j[1:] - 1.0)).sum(1)
    return torch.cat([slope - value**2 - 1.0, torch.stack([u[0], u[1] - u[0] ** 2 - 1.0])])


def _chebyquad(u: Tensor) -> Tensor:
    x = 2.0 * u - 1.0
    before, here = torch.ones_like(x), x
    rows = []
    for degree in range(1, len(u) + 1):
        integral = 0.0 if degree % 2 else -1.0 / (degree**2 - 1.0)
        rows.append(here.mean() - integral)
        before, here = here, 2.0 * x * here - before
    return torch.stack(rows)


def _jennrich_sampson(u: Tensor) -> Tensor:
    i = torch.arange(1.0, 11.0, dtype=u.dtype)
    return 2.0 + 2.0 * i - torch.exp(i * u[0]) - torch.exp(i * u[1])


def _freudenstein_roth(u: Tensor) -> Tensor:
    x, y = u
    return torch.stack(
        [
            -13.0 + x + ((5.0 - y) * y - 2.0) * y,
            -29.0 + x + ((y + 1.0) * y - 14.0) * y,
        ]
    )


def _powell_badly_scaled(u: Tensor) -> Tensor:
    x, y = u
    return torch.stack([1e4 * x * y - 1.0, torch.exp(-x) + torch.exp(-y) - 1.0001])


def _brown_badly_scaled(u: Tensor) -> Tensor:
    x, y = u
    return torch.stack([x - 1e6, y - 2e-6, x * y - 2.0])


def _beale(u: Tensor) -> Tensor:
    x, y = u
    powers = torch.stack([y, y**2, y**3])
    return torch.tensor([1.5, 2.25, 2.625], dtype=u.dtype) - x * (1.0 - powers)


def _linear_rank_one(u: Tensor) -> Tensor:
    i = torch.arange(1.0, 11.0, dtype=u.dtype)
    return i * (torch.arange(1.0, len(u) + 1.0, dtype=u.dtype) * u).sum() - 1.0


# Sums of squares at the minima, as the paper tabulates them; zero where it says zero.
MORE = {
    "Rosenbrock": Problem(
        lambda u: torch.stack([10.0 * (u[1] - u[0] ** 2), 1.0 - u[0]]), ((-1.2, 1.0),), (0.0,)
    ),
    "Freudenstein and Roth": Problem(_freudenstein_roth, ((0.5, -2.0),), (0.0, 48.98425)),
    "Powell badly scaled": Problem(_powell_badly_scaled, ((0.0, 1.0),), (0.0,)),
    "Brown badly scaled": Problem(_brown_badly_scaled, ((1.0, 1.0),), (0.0,)),
    "Beale": Problem(_beale, ((1.0, 1.0),), (0.0,)),
    "Jennrich and Sampson": Problem(_jennrich_sampson, ((0.3, 0.4),), (124.362,)),
    "helical valley": Problem(_helical_valley, ((-1.0, 0.0, 0.0),), (0.0,)),
    "Bard": Problem(_bard, ((1.0, 1.0, 1.0),), (8.21487e-3, 17.4286)),
    "Meyer": Problem(
        lambda u: (
            u[0] * torch.exp(u[1] / (torch.arange(50.0, 130.0, 5.0).double() + u[2])) - MEYER_Y
        ),
        ((0.02, 4000.0, 250.0),),
        (87.9458,),
    ),
    "Box, three dimensions": Problem(_box, ((0.0, 10.0, 20.0),), (0.0,)),
    "Powell singular": Problem(_powell_singular, ((3.0, -1.0, 0.0, 1.0),), (0.0,)),
    "Wood": Problem(_wood, ((-3.0, -1.0, -3.0, -1.0),), (0.0,)),
    "Brown and Dennis": Problem(_brown_dennis, ((25.0, 5.0, -5.0, -1.0),), (85822.2,)),
    "Watson, 6": Problem(_watson, ((0.0,) * 6,), (2.28767e-3,)),
    "Chebyquad, 8": Problem(_chebyquad, (tuple(k / 9.0 for k in range(1, 9)),), (3.51687e-3,)),
    "linear, rank one": Problem(_linear_rank_one, ((1.0,) * 5,), (10.0 * 9.0 / (2.0 * 21.0),)),
}
