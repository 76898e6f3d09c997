import pytest
import torch

from dolens import Rays, load_lens
from dolens.cached_tensors import cached_tensors, kept_by_content
from dolens.prescriptions import lens_from_prescription
from dolens.rendering import chief_ray_map


def test_a_kept_tensor_that_was_made_in_inference_mode_takes_part_in_gradients():
    @cached_tensors()
    def factors(count):
        return torch.arange(1.0, count + 1.0)

    with torch.inference_mode():
        factors(3)
    x = torch.ones(3, requires_grad=True)
    (x * factors(3)).sum().backward()
    assert x.grad.tolist() == [1.0, 2.0, 3.0]
    assert factors(3) is factors(3)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_lens_that_was_first_traced_in_inference_mode_has_gradients(backend):
    # A structure of its own, so that no other test has left its records behind.
    rows = [{"type": "sphere", "radius": 30.0 + n, "semi_diameter": 7.0 + n, "thickness": 1.0,
             "material": "1.5" if n % 2 == 0 else "air"} for n in range(9)]  # fmt: skip
    del rows[-1]["thickness"]
    prescription = {
        "surfaces": {str(n): row for n, row in enumerate(rows, 1)},
        "sensor": {"distance": 20.0},
    }
    lens = lens_from_prescription(prescription, backend=backend)
    rays = Rays(
        torch.tensor([[0.0, 1.0, -5.0]], dtype=torch.float64),
        torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
        550.0,
    )
    with torch.inference_mode():
        lens.trace(rays)
    lens.trace(rays).position.sum().backward()
    assert lens.surfaces["1"].curvature.grad.abs() > 0.0


def test_chebyshev_coefficients_that_were_first_made_in_inference_mode_have_gradients():
    values = torch.ones(7, dtype=torch.float64, requires_grad=True)
    with torch.inference_mode():
        chief_ray_map._to_coefficients(7)
    (chief_ray_map._to_coefficients(7) @ values).sum().backward()
    assert torch.isfinite(values.grad).all()


def test_a_tensor_first_made_within_a_transform_is_no_part_of_it():
    made = cached_tensors()(lambda count: torch.ones(count).to(torch.float64))
    torch.func.grad(lambda x: (x * made(3)).sum())(torch.ones(3, dtype=torch.float64))
    assert not torch._C._functorch.is_functorch_wrapped_tensor(made(3))


def test_results_serve_calls_with_equal_numbers_and_no_others():
    """Of a lens that is built anew, of a wavelength as a number, and of the order of two calls."""
    made = []

    @kept_by_content(maxsize=2)
    def doubled(system, wavelength):
        made.append(wavelength)
        return 2.0 * system.surfaces[0].parameters["curvature"]

    lens = load_lens("la1509")

    def seen(wavelength=550.0, **values):
        given = {f"surfaces.1.{name}": value for name, value in values.items()}
        return float(doubled(lens.with_values(given).system(), wavelength))

    with torch.no_grad():
        assert seen(curvature=0.01) == seen(curvature=0.01) == pytest.approx(0.02)
        assert seen(curvature=0.03) == pytest.approx(0.06) and len(made) == 2
        seen(curvature=0.01, wavelength=600.0)
        assert len(made) == 3
        seen(curvature=0.03)
        assert len(made) == 3
        seen(curvature=0.01)  # two were asked for since
        assert len(made) == 4
    curvature = torch.tensor(0.01, requires_grad=True)
    for _ in range(2):
        doubled(lens.with_values({"surfaces.1.curvature": curvature}).system(), 550.0).backward()
    assert float(curvature.grad) == 4.0 and len(made) == 6
    torch.func.grad(lambda c: doubled(lens.system({"surfaces.1.curvature": c}), 550.0))(curvature)
    assert len(made) == 7


def test_shapes_of_a_user_s_function_are_told_apart():
    made = []

    def shape(factor):
        class Shape:
            @staticmethod
            def sag(x):
                return factor * x

        return Shape

    @kept_by_content(maxsize=8)
    def sag(of, x):
        made.append(of)
        return of.sag(x)

    one, two = shape(2.0), shape(3.0)
    with torch.no_grad():
        assert [float(sag(of, torch.tensor(1.0))) for of in (one, two, one)] == [2.0, 3.0, 2.0]
    assert made == [one, two]


def test_what_was_kept_in_inference_serves_training():
    kept = kept_by_content(maxsize=1)(lambda count: torch.ones(count))
    with torch.inference_mode():
        kept(3)
    weight = torch.tensor(1.0, requires_grad=True)
    with torch.no_grad():
        ones = kept(3)
    (weight * ones).sum().backward()
    assert float(weight.grad) == 3.0
