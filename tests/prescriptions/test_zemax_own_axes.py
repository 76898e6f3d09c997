"""Tilts and decenters that a surface of a Zemax file has among its properties (SCBD)."""

import pytest
import torch

from dolens import Rays, load_lens

HEAD = "MODE SEQ\nUNIT MM\nENPD 4\nFTYP 0 0 1 1\nXFLN 0\nYFLN 0\nWAVM 1 0.55 1\nPWAV 1\n"
LENS = "  CURV 0.02\n  GLAS ___BLANK 1 0 1.5168 64.17 0\n"


def surface(number, lines, gap, kind="STANDARD"):
    return f"SURF {number}\n  TYPE {kind}\n{lines}  DISZ {gap}\n  DIAM 20\n"


def text(*surfaces):
    return HEAD + surface(0, "  CURV 0\n", "INFINITY") + "".join(surfaces)


def own(kind, order, status, *numbers):
    return f"  SCBD {kind} {order} {status} {' '.join(map(str, numbers))}\n"


def a_break(number, gap, order, *numbers):
    lines = "".join(f"  PARM {n} {v}\n" for n, v in enumerate((*numbers, order), 1))
    return surface(number, lines, gap, "COORDBRK")


def traced(path, content):
    path.write_text(content)
    lens = load_lens(path)
    y = torch.linspace(-1.0, 1.0, 5, dtype=torch.float64)
    start = torch.stack([0.3 * y, y, 0.0 * y - 5.0], -1)
    ahead = torch.tensor([0.02, -0.03, 1.0], dtype=torch.float64)
    hit = lens.trace(Rays(start, (ahead / ahead.norm()).expand(5, 3), 550.0))
    assert hit.valid.all()
    return lens, hit


MOVED = (0.4, -0.3, 6.0, -4.0, 11.0)
BACK = tuple(-value for value in MOVED)


@pytest.mark.parametrize(
    "status, after, order",
    [(0, (0.1, 0.2, 3.0, 1.0, -2.0), 0), (1, MOVED, 0), (2, BACK, 1), (5, BACK, 0)],
)
def test_they_are_breaks_around_the_surface(tmp_path, status, after, order):
    """By OpticStudio's help: a coordinate break, the surface, and another coordinate break."""
    stop = surface(1, "  STOP\n  CURV 0\n", 3)
    lines = LENS + own(1, 0, 0, *MOVED) + own(2, order, status, *after)
    short = text(stop, surface(2, lines, 4), surface(3, "  CURV 0.0\n", 40), surface(4, "", 0))
    long = text(
        stop,
        a_break(2, 0, 0, *MOVED),
        surface(3, LENS, 0),
        a_break(4, 4, order, *after),
        surface(5, "  CURV 0.0\n", 40),
        surface(6, "", 0),
    )
    lens, hit = traced(tmp_path / "short.zmx", short)
    _, expected = traced(tmp_path / "long.zmx", long)
    assert [s.kind for s in lens.surfaces.values()][1:4:2] == ["coordinate_break"] * 2
    assert torch.equal(hit.position, expected.position)
    assert torch.equal(hit.path_length, expected.path_length)


def test_a_fold_mirror_turns_the_axis_twice(tmp_path):
    """45° before the mirror and once more behind it: the axis leads down, and meets the image."""
    tilt = (0, 0, 45, 0, 0)
    mirror = "  CURV 0\n  GLAS MIRROR 0 0\n" + own(1, 0, 0, *tilt) + own(2, 0, 1, *tilt)
    lens, _ = traced(
        tmp_path / "fold.zmx",
        text(surface(1, "  STOP\n  CURV 0\n", 30), surface(2, mirror, -25), surface(3, "", 0)),
    )
    axis = Rays(torch.tensor([[0.0, 0.0, 0.0]]).double(), torch.tensor([[0.0, 0, 1]]).double(), 550)
    assert lens.trace(axis).position[0, :2].abs().max() < 1e-13
    origin = lens.global_axes().origin[-1]
    assert (origin - torch.tensor([0.0, 25.0, 30.0]).double()).abs().max() < 1e-13


def test_axes_undone_leave_the_rest_where_it_was(tmp_path):
    lines = LENS + own(1, 0, 0, *MOVED) + own(2, 1, 2, *BACK)
    image = "  CURV 0\n" + own(1, 0, 0, 0.0, 0.0, 7.0, 0.0, 0.0)
    lens, _ = traced(
        tmp_path / "lens.zmx",
        text(surface(1, "  STOP\n  CURV 0\n", 3), surface(2, lines, 4),
             surface(3, "  CURV 0.0\n", 40), surface(4, image, 0)),
    )  # fmt: skip
    axes = lens.global_axes()
    assert (axes.origin[-1] - torch.tensor([0.0, 0.0, 47.0]).double()).abs().max() < 1e-13
    assert (axes.rotation[4] - torch.eye(3).double()).abs().max() < 1e-15
    # The image itself is tilted about x.
    assert float(axes.rotation[-1, 2, 2]) == pytest.approx(0.992546151641322)
