"""Every ray of tests/reference/rays (28 digits, two independent programs)."""

import pytest
import torch
import yaml

from dolens import Rays, Status
from dolens.prescriptions import lens_from_prescription

pytestmark = pytest.mark.usefixtures("backend")

FILES = {
    "rays_asphere_initial__dfc.json": ("asphere", {}),
    "rays_largefov__dfc.json": ("large_fov_doublet", {}),
    "rays_triplet__dfc.json": ("cooke_triplet", {}),
    "rays_triplet__do.json": ("cooke_triplet", {}),
    "rays_triplet_misaligned_e1_tilt.json": ("cooke_triplet", {}),
    "rays_wfc_cubic_1e-4__dfc.json": (
        "wavefront_coding",
        {"surfaces.5.x3": 1e-4, "surfaces.5.y3": 1e-4},
    ),
}
STATUS = {"ok": Status.OK, "vignetted": Status.VIGNETTED, "tir": Status.TIR, "miss": Status.MISSED}
SENSOR_TOLERANCE = {torch.float64: 1e-11, torch.float32: 5e-5}


def numbers(rows):
    return torch.tensor([[float(v) for v in row] for row in rows], dtype=torch.float64)


@pytest.fixture(scope="module", params=FILES, ids=lambda f: f[5:-5])
def reference_bundle(request, reference):
    data = reference(f"rays/{request.param}")
    return request.param, data


def make_lens(root, name, data, dtype):
    lens_name, values = FILES[name]
    text = (root / "conf" / "lens" / f"{lens_name}.yaml").read_text(encoding="utf-8")
    prescription = yaml.safe_load(text) | {"elements": written_elements(data)}
    lens = lens_from_prescription(prescription, dtype, data["index_model"])
    with torch.no_grad():
        for parameter, value in values.items():
            dict(lens.named_parameters())[parameter].fill_(value)
    return lens


def written_elements(data):
    """The reference's poses as a prescription writes them."""
    elements = {}
    for name, pose in data.get("pose", {"elements": {}})["elements"].items():
        tilts = zip(("tilt_x", "tilt_y", "tilt_z"), pose["theta_deg"], strict=True)
        shifts = zip(("decenter_x", "decenter_y", "shift_z"), pose["shift"], strict=True)
        elements[name] = {"surfaces": pose["surfaces"]}
        elements[name] |= {key: float(value) for key, value in (*tilts, *shifts)}
    return elements


def launch(rays):
    return Rays(
        numbers(r["o"] for r in rays),
        numbers(r["d"] for r in rays),
        torch.tensor([float(r["wavelength"]) for r in rays], dtype=torch.float64),
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
def test_sensor_points(reference_bundle, root, dtype):
    name, data = reference_bundle
    hit = make_lens(root, name, data, dtype).trace(launch(data["rays"]))
    assert hit.position.dtype == dtype
    reached = [i for i, r in enumerate(data["rays"]) if r["sensor"] is not None]
    assert {data["rays"][i]["status"] for i in reached} == {"ok", "vignetted"}
    expected = numbers(data["rays"][i]["sensor"] for i in reached)
    error = (hit.position[reached].double() - expected).abs()
    assert error.max() < SENSOR_TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
def test_validity_status_and_failing_surface(reference_bundle, root, dtype):
    name, data = reference_bundle
    hit = make_lens(root, name, data, dtype).trace(launch(data["rays"]))
    for i, ray in enumerate(data["rays"]):
        found = (bool(hit.valid[i]), int(hit.status[i]), int(hit.surface[i]))
        assert found == (ray["valid"], STATUS[ray["status"]], ray["fail_surface"] or 0), ray["id"]


def test_every_intersection_up_to_where_a_ray_ends(reference_bundle, root):
    name, data = reference_bundle
    hit = make_lens(root, name, data, torch.float64).trace(launch(data["rays"]), record=True)
    assert hit.points.shape == (len(data["surfaces"]), len(data["rays"]), 3)
    compared = 0
    for i, ray in enumerate(data["rays"]):
        met = [p for p in ray["points"] if p is not None]
        if met:
            error = (hit.points[: len(met), i] - numbers(met)).abs().max()
            assert error < 1e-11, (ray["id"], ray["status"])
            compared += len(met)
    assert compared > len(data["rays"])


def test_directions_and_path_lengths(reference_bundle, root):
    name, data = reference_bundle
    hit = make_lens(root, name, data, torch.float64).trace(launch(data["rays"]))
    for i, ray in enumerate(data["rays"]):
        if ray["sensor"] is None:
            continue
        direction = numbers([ray["d_out"]])[0]
        assert (hit.direction[i] - direction).abs().max() < 1e-11, ray["id"]
        opl = float(ray["opl"])
        # Absolute, sources at eight metres included.
        assert abs(float(hit.path_length[i].detach()) - opl) < 1e-11, ray["id"]


def test_light_returns_the_way_it_came(reference_bundle, root):
    name, data = reference_bundle
    lens = make_lens(root, name, data, torch.float64)
    rays = [r for r in data["rays"] if r["valid"]]
    back = Rays(
        numbers(r["sensor"] for r in rays),
        -numbers(r["d_out"] for r in rays),
        torch.tensor([float(r["wavelength"]) for r in rays], dtype=torch.float64),
    )
    hit = lens.sensor_to_scene(back, record=True)
    assert hit.valid.all()
    for position, surface in ((hit.points[-1], 0), (hit.points[0], -1), (hit.position, 0)):
        expected = numbers(r["points"][surface] for r in rays)
        assert (position - expected).abs().max() < 1e-10
    assert (hit.direction + numbers(r["d"] for r in rays)).abs().max() < 1e-10
