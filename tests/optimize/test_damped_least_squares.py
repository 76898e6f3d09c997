"""Damped least squares on problems whose solutions others have certified."""

import math

import pytest
import torch

from dolens import Rays, load_lens
from dolens.errors import InputError
from dolens.optics.ray_tracing import trace_rays
from dolens.optimize import DampedLeastSquares
from dolens.optimize.batch_least_squares import BatchModel, minimise_batch
from dolens.optimize.linear_least_squares import (
    LinearModel,
    TensorResiduals,
    _say_reverse,
    bounded_step,
)
from tests.optimize.standard_problems import CERTIFIED, MORE

# From these two of NIST's harder starts it does not get there.  BoxBOD: the first step leads to
# where the exponential is flat, a minimum of its own, as MINPACK's does.  MGH10: a canyon that
# bends, in which it takes over 10 000 evaluations, MINPACK 550 (see `scripts/least_squares.py`).
HARDEST = {("BoxBOD", 0), ("MGH10", 0)}
STARTS = [
    (name, k)
    for name, problem in CERTIFIED.items()
    for k in range(len(problem.starts))
    if (name, k) not in HARDEST
]


def minimise(residuals, start, steps=2000, dtype=torch.float64, lower=None, upper=None, **options):
    """The variables and the optimizer when it stops."""
    u = torch.tensor(start, dtype=dtype, requires_grad=True)
    optimizer = DampedLeastSquares([{"params": [u], "lower": lower, "upper": upper}], **options)
    for _ in range(steps):
        optimizer.step(lambda: residuals(u))
        if optimizer.stopped:
            break
    return u.detach(), optimizer


@pytest.mark.parametrize("name, k", STARTS)
def test_certified_regressions(name, k):
    """NIST's sums of squares, and its parameters to the digits that the sums' rounding leaves."""
    problem = CERTIFIED[name]
    u, optimizer = minimise(problem.residuals, problem.starts[k], merit_tolerance=0.0)
    assert optimizer.stopped
    assert optimizer.last.merit == pytest.approx(problem.minima[0], rel=1e-10)
    for found, certified in zip(u.tolist(), problem.solution, strict=True):
        assert found == pytest.approx(certified, rel=1e-7)


@pytest.mark.parametrize("damping", ["multiplicative", "identity"])
@pytest.mark.parametrize("name", MORE)
def test_problems_of_more_garbow_and_hillstrom(name, damping):
    problem = MORE[name]
    _, optimizer = minimise(problem.residuals, problem.starts[0], damping=damping, steps=5000)
    merit = optimizer.last.merit
    assert any(
        merit <= 1e-14 if minimum == 0.0 else merit == pytest.approx(minimum, rel=5e-6)
        for minimum in problem.minima
    ), (merit, optimizer.stopped)


def rosenbrock(u):
    return torch.stack([10.0 * (u[1] - u[0] ** 2), 1.0 - u[0]])


@pytest.mark.parametrize(("bounds", "error"), [("active", 1e-8), ("projected", 1e-4)])
def test_a_bound_that_the_minimum_lies_behind(bounds, error):
    """With u₁ ≤ 0.5 the least sum of squares is at (0.5, 0.25): 0.25 + 100·(u₂ - 0.25)².

    Half of the merit's digits is what it tells of the variables; projection gains ever less.
    """
    u, optimizer = minimise(rosenbrock, (-1.2, 1.0), upper=torch.tensor([0.5, 2.0]), bounds=bounds)
    assert optimizer.stopped
    assert u.tolist() == pytest.approx([0.5, 0.25], rel=error)
    assert optimizer.last.merit == pytest.approx(0.25, abs=100.0 * error**2)


def test_active_bounds_take_fewer_iterations_than_projection():
    """A narrow valley along which the step must turn once a variable is stopped."""
    generator = torch.Generator().manual_seed(5)
    turn = torch.linalg.qr(torch.randn(12, 12, generator=generator, dtype=torch.float64)).Q
    rows = turn @ torch.diag(torch.logspace(0, -3, 12, dtype=torch.float64)) @ turn.T
    target = torch.randn(12, generator=generator, dtype=torch.float64)

    def residuals(u):
        return rows @ (u - target)

    found = {}
    for bounds in ("active", "projected"):
        steps = 0

        def counted(u):
            nonlocal steps
            steps += u.requires_grad and torch.is_grad_enabled()
            return residuals(u)

        _, optimizer = minimise(counted, (0.0,) * 12, lower=-0.5, upper=0.5, bounds=bounds)
        found[bounds] = (optimizer.last.merit, steps)
    assert found["active"][0] <= found["projected"][0] * (1.0 + 1e-9)
    assert 3 * found["active"][1] < found["projected"][1]


def test_starts_on_and_beyond_a_bound():
    for start in (2.0, 5.0):
        u, optimizer = minimise(lambda u: u - 1.0, (start,), lower=-3.0, upper=2.0)
        assert float(u) == pytest.approx(1.0, rel=1e-12)
        assert "fallen" in optimizer.stopped or "zero" in optimizer.stopped
    u, optimizer = minimise(lambda u: u - 1.0, (2.0,), lower=2.0, upper=3.0)
    assert float(u) == 2.0
    assert optimizer.stopped == "every variable is pressed against its bound"


def test_rank_deficient_problems_end_at_a_minimum():
    """Two variables that only their sum matters for, and one that nothing depends on."""

    def residuals(u):
        return torch.stack([u[0] + u[1] - 3.0, 2.0 * (u[0] + u[1]) - 6.5, u[0] * 0.0])

    u, optimizer = minimise(residuals, (0.0, 0.0, 7.0))
    assert optimizer.stopped
    assert float(u[0] + u[1]) == pytest.approx(3.2, rel=1e-9)
    assert float(u[0]) == pytest.approx(float(u[1]), rel=1e-9)
    assert float(u[2]) == 7.0


@pytest.mark.parametrize("damping", ["multiplicative", "identity"])
def test_residuals_that_turn_nan_shrink_the_step(damping):
    """√u ends at zero: the first step of Gauss and Newton would leap beyond it."""
    u, optimizer = minimise(
        lambda u: torch.stack([u[0].sqrt() - 0.1, 0.01 * (u[0] - 0.01)]), (4.0,), damping=damping
    )
    assert float(u) == pytest.approx(0.01, rel=1e-6)
    assert optimizer.stopped


def test_failed_trials_are_counted_and_the_start_must_be_finite():
    u = torch.tensor([4.0], dtype=torch.float64, requires_grad=True)
    optimizer = DampedLeastSquares([u], initial_damping=1e-12)
    optimizer.step(lambda: u.sqrt() - 0.1)
    assert optimizer.last.failed_trials > 0 and optimizer.last.merit < optimizer.last.merit_before
    with torch.no_grad():
        u.fill_(-1.0)
    with pytest.raises(InputError, match="least squares cannot begin: the merit is nan"):
        optimizer.step(lambda: u.sqrt())
    assert float(u.detach()) == -1.0


def test_when_nothing_helps_it_says_what_it_tried():
    """A merit that is finite at one point only."""
    start = 3.0

    def residuals(u):
        return u if float(u.detach()) == start else u / 0.0

    u, optimizer = minimise(residuals, (start,), max_trials=7)
    assert float(u) == start
    assert optimizer.stopped == "no step lowers the merit: 7 were tried, 7 failed"
    again = optimizer.step(lambda: pytest.fail("it had stopped"))
    assert float(again) == start**2
    optimizer.restart()
    assert optimizer.stopped is None


def test_multiplicative_damping_does_not_care_about_units():
    """The same problem in metres and in micrometres takes the same steps."""
    problem = MORE["Bard"]
    unit = torch.tensor([1e-6, 1.0, 1e4], dtype=torch.float64)
    merits = []
    for scale in (torch.ones(3, dtype=torch.float64), unit):
        u = (torch.ones(3, dtype=torch.float64) / scale).requires_grad_()
        optimizer = DampedLeastSquares([u])
        merits.append(
            [float(optimizer.step(lambda u=u, s=scale: problem.residuals(u * s))) for _ in range(8)]
        )
    assert merits[0] == pytest.approx(merits[1], rel=1e-9)


def test_groups_and_resuming_from_a_checkpoint(tmp_path):
    """Saved as plain tensors after five iterations, it goes on to the bit."""

    def setup():
        a = torch.tensor([-1.2], dtype=torch.float64, requires_grad=True)
        b = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
        optimizer = DampedLeastSquares(
            [{"params": [a], "upper": 0.9}, {"params": [b], "lower": 0.0}]
        )
        return a, b, optimizer, lambda: rosenbrock(torch.cat([a, b]))

    a, b, optimizer, closure = setup()
    for _ in range(5):
        optimizer.step(closure)
    torch.save({"optimizer": optimizer.state_dict(), "u": (a, b)}, tmp_path / "state.ckpt")
    expected = [float(optimizer.step(closure)) for _ in range(5)]
    a, b, optimizer, closure = setup()
    state = torch.load(tmp_path / "state.ckpt", weights_only=True)
    optimizer.load_state_dict(state["optimizer"])
    with torch.no_grad():
        a.copy_(state["u"][0])
        b.copy_(state["u"][1])
    assert [float(optimizer.step(closure)) for _ in range(5)] == expected


def test_a_checkpoint_has_the_words_why_it_stopped():
    u, optimizer = minimise(rosenbrock, (-1.2, 1.0))
    resumed = DampedLeastSquares([u])
    resumed.load_state_dict(optimizer.state_dict())
    assert resumed.stopped == optimizer.stopped and " " in resumed.stopped


def test_float32_variables_reach_their_own_precision():
    u, optimizer = minimise(rosenbrock, (-1.2, 1.0), dtype=torch.float32)
    assert optimizer.stopped
    assert u.tolist() == pytest.approx([1.0, 1.0], rel=1e-5)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"damping": "additive"},
            "damping: 'additive' is unknown \\(allowed: multiplicative, identity",
        ),
        ({"bounds": "soft"}, "bounds: 'soft' is unknown \\(allowed: active, projected"),
        ({"merit_tolerance": -1.0}, "merit_tolerance must be at least 0 and below 1"),
        ({"initial_damping": 0.0}, "initial_damping must be positive"),
        ({"max_trials": 0}, "max_trials must be at least 1"),
        ({"lower": 2.0, "upper": 1.0}, "variable 0: lower bound 2 exceeds upper 1"),
    ],
)
def test_bad_settings_are_refused(options, said):
    with pytest.raises(InputError, match=said):
        minimise(rosenbrock, (-1.2, 1.0), **options)


def test_a_jacobian_that_is_not_finite_is_refused():
    with pytest.raises(InputError, match="the Jacobian is not finite"):
        minimise(lambda u: torch.where(u > 0.0, u, (-u).sqrt()), (1.0,))


@pytest.mark.parametrize("count", [3, 200])
def test_the_jacobian_of_few_and_of_many_residuals(count):
    """By reverse sweeps, and by forward ones where residuals are many: jacfwd's numbers."""
    u = torch.tensor([0.3, -0.7], dtype=torch.float64, requires_grad=True)
    w = torch.tensor([1.1], dtype=torch.float64, requires_grad=True)
    t = torch.linspace(0.0, 1.0, count, dtype=torch.float64)

    def residuals(u, w):
        return torch.exp(u[0] * t) * torch.sin(w * t) + u[1] ** 2

    model = TensorResiduals(residuals(u, w), [u, w]).linear_model()
    jacobian = torch.cat(torch.func.jacfwd(residuals, (0, 1))(u.detach(), w.detach()), 1)
    assert torch.allclose(model.root.T @ model.root, jacobian.T @ jacobian, rtol=1e-12)
    assert torch.allclose(model.gradient, jacobian.T @ residuals(u, w).detach(), rtol=1e-12)


def test_residuals_without_a_second_derivative_take_reverse_sweeps(triplet_residuals, caplog):
    """A trace by the fused kernels: the log says so, and the Jacobian is right."""
    residuals, curvature, step = triplet_residuals
    _say_reverse.cache_clear()  # it is said once a process, and another test may have been first
    with caplog.at_level("INFO"):
        model = TensorResiduals(residuals(curvature), [curvature]).linear_model()
    assert "one reverse sweep for each residual" in caplog.text
    with torch.no_grad():
        slope = (residuals(curvature + step) - residuals(curvature - step)) / (2.0 * step)
    assert model.column_norms[0].item() == pytest.approx(slope.norm().item(), rel=1e-7)


@pytest.fixture
def triplet_residuals(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=torch.float64)
    lens.requires_grad_(False)
    lens.backend = "cpu"
    y = torch.linspace(-3.0, 3.0, 12, dtype=torch.float64)
    position = torch.stack((0.1 * y, y, torch.full_like(y, -5.0)), -1)
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(12, 3)
    rays = Rays(position, direction, 587.5618)

    def residuals(curvature):
        system = lens.system({"surfaces.1.curvature": curvature})
        return trace_rays(system, rays).position[:, :2].reshape(-1)

    return residuals, lens.surfaces["1"].curvature.detach().clone().requires_grad_(), 1e-6


def test_problems_without_variables_or_residuals_are_named():
    none = torch.zeros(0, dtype=torch.float64)
    model = LinearModel(1.0, torch.zeros(3, 0).double(), torch.ones(3).double())
    nothing = BatchModel(torch.ones(2).double(), none.expand(2, 0), torch.zeros(2, 0, 0).double())
    for call in (
        lambda: DampedLeastSquares([]),
        lambda: DampedLeastSquares([none.requires_grad_()]),
        lambda: minimise_batch(lambda *_: nothing, none.expand(2, 0), none, none, 3),
        lambda: bounded_step(model, none, none, none),
    ):
        with pytest.raises(InputError, match=r"^least squares: there are no variables$"):
            call()
    u = torch.ones(2, dtype=torch.float64, requires_grad=True)
    with pytest.raises(InputError, match=r"^least squares: there are no residuals$"):
        DampedLeastSquares([u]).step(lambda: u[:0])


@pytest.mark.parametrize(
    "returned, said",
    [
        (lambda u: None, "the closure returns NoneType; allowed: a tensor of residuals"),
        (lambda u: 3.0, "the closure returns float; allowed"),
        (lambda u: [u], "the closure returns list; allowed"),
        (lambda u: u * 1j, "the residuals are complex"),
        (lambda u: torch.ones(3), "have no gradient"),
        (lambda u: u * math.nan, "the merit is nan"),
        (lambda u: u * 1e300, "the merit is inf"),
    ],
)
def test_a_closure_that_returns_no_residuals_is_named(returned, said):
    u = torch.ones(2, dtype=torch.float64, requires_grad=True)
    with pytest.raises(InputError, match=said):
        DampedLeastSquares([u]).step(lambda: returned(u))


def test_a_variable_without_a_gradient_is_named():
    u, fixed = (torch.ones(2, dtype=torch.float64, requires_grad=g) for g in (True, False))
    with pytest.raises(InputError, match="a variable has no gradient"):
        DampedLeastSquares([u, fixed]).step(lambda: u * fixed)
