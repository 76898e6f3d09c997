"""A sag on a grid: exact for cubics, close for others, and where the grid ends."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline, RectBivariateSpline

from dolens import InputError, Rays, Status
from dolens.optics.splines import spline_slopes
from dolens.optics.surfaces import EvenAsphere, GridSag
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of

F64 = torch.float64
BASE = {"curvature": 0.02, "conic": -0.5, "a4": 1e-6}


def grid(function, columns=11, rows=9, spacing=(1.2, 1.5), **more):
    """A surface whose sag on the grid is a function of x and y from the grid's middle."""
    x = spacing[0] * (torch.arange(columns, dtype=F64) - 0.5 * (columns - 1))
    y = spacing[1] * (torch.arange(rows, dtype=F64) - 0.5 * (rows - 1))
    sag = function(x[None, :], y[:, None]).expand(rows, columns)
    return GridSag(
        5.0, BASE | {"sag": sag, "spacing_x": spacing[0], "spacing_y": spacing[1]} | more
    )


def parameters(surface):
    return {n: p.detach() for n, p in (*surface.named_parameters(), *surface.named_buffers())}


def points():
    generator = torch.Generator().manual_seed(2)
    return 10.0 * torch.rand((2, 200), generator=generator, dtype=F64) - 5.0


def cubic(x, y):
    return 1e-3 * (x**3 - 2.0 * x**2 * y + x * y**3 / 5.0) + 0.01 * x * y + 0.02 * y


def test_a_bicubic_polynomial_is_reproduced():
    surface = grid(cubic)
    x, y = points()
    base = EvenAsphere.sag_and_gradient(
        {n: torch.tensor(v, dtype=F64) for n, v in BASE.items()}, x, y
    )
    xs, ys = x.clone().requires_grad_(), y.clone().requires_grad_()
    expected = cubic(xs, ys)
    slopes = torch.autograd.grad(expected.sum(), (xs, ys))
    found = surface.sag_and_gradient(parameters(surface), x, y)
    for a, b, added in zip(found[:3], base[:3], (expected.detach(), *slopes), strict=True):
        assert (a - b - added).abs().max() < 2e-14


def test_without_slopes_it_is_the_spline_through_the_nodes():
    """SciPy's own bicubic spline through the same nodes, another program."""

    def wave(x, y):
        return 0.02 * torch.sin(0.7 * x) * torch.cos(0.5 * y)

    surface = grid(wave)
    p = parameters(surface)
    u = 1.2 * (torch.arange(11, dtype=F64) - 5.0)
    v = 1.5 * (torch.arange(9, dtype=F64) - 4.0)
    spline = RectBivariateSpline(u, v, p["sag"].T, kx=3, ky=3, s=0)
    x, y = points()
    added = GridSag.added_terms(p, x, y)
    for found, dx, dy in zip(added, (0, 1, 0), (0, 0, 1), strict=True):
        expected = torch.from_numpy(spline.ev(x.numpy(), y.numpy(), dx=dx, dy=dy))
        assert (found - expected).abs().max() < 1e-14


def test_slopes_that_are_given_are_used():
    """A plane whose nodes are said to be steep: Hermite's x(1 - x)² beside a node."""
    surface = grid(lambda x, y: 0.0 * x * y, slope_x=torch.full((9, 11), 0.1, dtype=F64))
    p = parameters(surface)
    x = torch.tensor([0.3], dtype=F64)
    t = 0.3 / 1.2
    expected = 0.1 * 1.2 * (t * (1 - t) ** 2 - t * t * (1 - t))
    assert float(GridSag.added_terms(p, x, 0.0 * x)[0]) == pytest.approx(expected, rel=1e-13)


def test_a_decentred_grid_lies_elsewhere():
    here, there = grid(cubic), grid(cubic, decenter_x=0.8, decenter_y=-0.4)
    x, y = 0.4 * points()
    found = GridSag.added_terms(parameters(there), x + 0.8, y - 0.4)[0]
    assert (found - GridSag.added_terms(parameters(here), x, y)[0]).abs().max() < 1e-15


def row(surface, **more):
    lens = {"type": "grid_sag", "semi_diameter": surface.semi_diameter, "material": "1.5/60"}
    return lens | {n: p.tolist() for n, p in parameters(surface).items()} | more


def test_a_ray_beyond_the_grid_misses_it():
    surface = grid(cubic)
    lens = lens_from_prescription({"surfaces": {"1": row(surface)}, "sensor": {"distance": 5.0}})
    start = torch.tensor([[5.9, 0.0, -5.0], [6.1, 0.0, -5.0], [3.0, 1.0, -5.0]], dtype=F64)
    hit = lens.trace(Rays(start, torch.tensor([0.0, 0.0, 1.0], dtype=F64)))
    assert [Status(int(s)) for s in hit.status] == [Status.VIGNETTED, Status.MISSED, Status.OK]
    assert torch.isfinite(hit.position).all()


def test_it_comes_back_from_yaml_and_from_zemax(tmp_path):
    surface = grid(cubic)
    data = {"surfaces": {"1": row(surface)}, "sensor": {"distance": 5.0}}
    lens = lens_from_prescription(data)
    saved = prescription_of(lens)
    again = lens_from_prescription(saved)
    for name, value in parameters(surface).items():
        assert torch.equal(parameters(again.surfaces["1"])[name], value), name
    for without in ((), ("slope_x", "slope_y", "twist")):
        plain = {
            k: v
            for k, v in saved["surfaces"]["1"].items()
            if not k.startswith("decenter") and k not in without
        }
        found = prescription_from_zemax(zemax_of(saved | {"surfaces": {"1": plain}}))
        assert found["surfaces"]["1"]["sag"] == plain["sag"]
        assert ("slope_x" in found["surfaces"]["1"]) == ("slope_x" in plain)


def test_zemax_lists_nodes_from_the_upper_left():
    """A tilted grid: dz/dx > 0 and dz/dy > 0, so that the first row has positive y."""
    surface = grid(lambda x, y: 0.1 * x + 0.01 * y, columns=3, rows=3, spacing=(5.0, 5.0))
    plain = {k: v for k, v in row(surface).items() if not k.startswith("decenter")}
    text = zemax_of({"surfaces": {"1": plain}, "sensor": {"distance": 5.0}, "name": "grid"})
    nodes = [line.split()[2] for line in text.splitlines() if line.strip().startswith("GARR")]
    first, second, *_, last = (float(node) for node in nodes)
    assert first == pytest.approx(-0.45) and second == pytest.approx(0.05)
    assert last == pytest.approx(0.45)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"sag": [1.0, 2.0]}, "at least 2 rows"),
        ({"slope_x": [[1.0]]}, "as many rows and columns as 'sag', 9 × 11"),
        ({"spacing_x": 0.0}, "'spacing_x' and 'spacing_y' must be given and positive"),
        ({"spacing_x": 0.5}, "the grid only 2.5 mm"),
        ({"decenter_y": 1.2}, "along y, and the grid only 6 mm"),
        ({"sags": 1.0}, "sags"),
    ],
)
def test_a_wrong_grid_is_one_line_about_its_key(more, message):
    data = row(grid(cubic)) | more
    if "spacing_x" in more:
        data = {k: v for k, v in data.items() if k not in ("slope_x", "slope_y", "twist")}
    with pytest.raises(InputError, match=message):
        lens_from_prescription({"surfaces": {"1": data}, "sensor": {"distance": 5.0}})


def test_the_error_falls_with_the_fourth_power_of_the_spacing():
    def bump(x, y):
        return 0.05 * torch.exp(-(x * x + y * y) / 20.0)

    x, y = 0.8 * points()
    errors = []
    for half in (12, 24):
        spacing = 6.0 / half
        surface = grid(bump, 2 * half + 1, 2 * half + 1, (spacing, spacing))
        found = GridSag.added_terms(parameters(surface), x, y)[0]
        errors.append(float((found - bump(x, y)).abs().max()))
    assert math.log2(errors[0] / errors[1]) > 3.5


def test_slopes_of_splines_are_those_of_scipy_at_any_nodes():
    nodes, values = np.array([0.0, 1.0, 1.5, 4.0, 4.2, 7.0]), np.arange(12.0).reshape(2, 6) ** 1.7
    for count in (2, 3, 4, 6):
        exact = CubicSpline(nodes[:count], values[:, :count], axis=1)(nodes[:count], 1)
        np.testing.assert_allclose(spline_slopes(values[:, :count], nodes[:count]), exact)
