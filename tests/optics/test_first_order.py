"""First-order properties against tests/reference/first_order.json (28 digits)."""

import pytest
import torch

from dolens import load_lens
from dolens.optics.paraxial import chief_ray_magnification, exit_pupil

LENSES = {
    "asphere_initial": "asphere",
    "asphere_optimized": "asphere_optimized",
    "triplet": "cooke_triplet",
    "nikon_original": "nikon",
    "nikon_optimized": "nikon_optimized",
    "wfc_flat": "wavefront_coding",
    "wfc_cubic_1e-4": "wavefront_coding",  # a cubic plate has no first-order power
    "largefov": "large_fov_doublet",
}


def relative(found, expected):
    expected = float(expected)
    return abs(float(found.detach()) - expected) / max(abs(expected), 1e-300)


@pytest.mark.parametrize("model", ["dfc", "do", "paper"])
@pytest.mark.parametrize("lens_name", LENSES)
def test_every_first_order_property(reference, root, lens_name, model):
    entries = reference("first_order.json")["data"][lens_name][model]
    assert len(entries) == 5
    lens = load_lens(
        root / "conf" / "lens" / f"{LENSES[lens_name]}.yaml", torch.float64, index_model=model
    )
    for wavelength, expected in entries.items():
        found = lens.first_order(float(wavelength))
        assert lens.stop == expected["stop_surface"]
        assert relative(found.efl, expected["efl"]) < 1e-12
        assert relative(found.efl * found.image_index, expected["efl_image_space"]) < 1e-12
        assert relative(found.bfd, expected["bfd"]) < 1e-12
        assert relative(found.focus, expected["z_focus"]) < 1e-12
        assert relative(lens.system().vertices[-1], expected["z_sensor"]) < 1e-12
        if float(expected["ep_z"]) == 0.0:
            assert float(found.entrance_pupil.z) == 0.0
        else:
            assert relative(found.entrance_pupil.z, expected["ep_z"]) < 1e-12
        assert relative(found.entrance_pupil.diameter, expected["ep_diameter"]) < 1e-12
        assert relative(found.f_number, expected["fno_stop"]) < 1e-12


@pytest.mark.parametrize("lens_name", ["cooke_triplet", "asphere", "wavefront_coding", "nikon"])
def test_gradient_of_the_focal_length(root, lens_name):
    lens = load_lens(root / "conf" / "lens" / f"{lens_name}.yaml")
    parameters = lens.variables(["surfaces.*.curvature", "thicknesses.*"])
    gradients = torch.autograd.grad(lens.first_order().efl, parameters.values(), allow_unused=True)
    checked = 0
    for (name, parameter), gradient in zip(parameters.items(), gradients, strict=True):
        step = 1e-6 * max(abs(float(parameter.detach())), 1e-2)
        ends = []
        for sign in (+1, -1):
            with torch.no_grad():
                kept = parameter.clone()
                parameter += sign * step
                ends.append(float(lens.first_order().efl.detach()))
                parameter.copy_(kept)
        expected = (ends[0] - ends[1]) / (2.0 * step)
        found = 0.0 if gradient is None else float(gradient)
        # Truncation is ~1e-9 relative; rounding of the difference ~1e-14·efl/step.
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-13 * 100.0 / step), name
        checked += 1
    assert checked == len(parameters) > 1


def test_thin_lens_in_closed_form(thin_lens):
    """1/s' = 1/s + 1/f, y'/y = s'/s, for a lens so thin that its thickness does not count."""
    system = thin_lens.system()
    focal = float(thin_lens.first_order().efl.detach())
    assert focal == pytest.approx(100.0, rel=1e-12)
    depth = 400.0
    image = 1.0 / (1.0 / focal - 1.0 / depth)
    found = float(thin_lens.first_order(587.5618, depth).image.detach())
    assert found == pytest.approx(image, rel=1e-12)
    assert float(chief_ray_magnification(system, 587.5618, depth).detach()) == pytest.approx(
        -float(system.sensor_distance) / depth, rel=1e-12
    )
    pupil = exit_pupil(system, 587.5618)
    assert float(pupil.z) == pytest.approx(0.0, abs=1e-12)
    assert float(pupil.diameter) == pytest.approx(20.0, rel=1e-12)


@pytest.fixture
def thin_lens():
    from dolens.prescriptions import lens_from_prescription

    surface = {"type": "sphere", "semi_diameter": 10.0}
    return lens_from_prescription(
        {
            "surfaces": {
                "1": {**surface, "radius": 100.0, "thickness": 0.0, "material": "1.5/60"},
                "2": {**surface, "radius": -100.0, "material": "air"},
            },
            "sensor": {"distance": 120.0},
        }
    )
