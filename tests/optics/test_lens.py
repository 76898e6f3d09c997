"""A lens as an object: its parameters by name, its copies, its state."""

import copy
import re

import pytest
import torch

from dolens import InputError, Rays, load_lens
from dolens.optics.lens import Lens
from dolens.optics.materials import index_model, parse_material
from dolens.optics.surfaces import Plane, Sphere

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def triplet(root):
    return load_lens(root / "conf" / "lens" / "cooke_triplet.yaml")


@pytest.fixture
def axial():
    return Rays(
        torch.tensor([[1.0, 2.0, -5.0]], dtype=torch.float64),
        torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
    )


def test_names_of_parameters(triplet):
    assert set(dict(triplet.named_parameters())) == {
        *(f"surfaces.{n}.curvature" for n in range(1, 7)),
        *(f"thicknesses.{n}" for n in range(1, 6)),
        "sensor_distance",
    }


def test_variables_by_pattern(triplet):
    chosen = triplet.variables(["sensor_distance", "surfaces.[12].*"])
    assert set(chosen) == {"surfaces.1.curvature", "surfaces.2.curvature", "sensor_distance"}
    assert chosen["sensor_distance"] is triplet.sensor_distance
    assert len(triplet.variables(["*"])) == 12
    assert list(triplet.variables(["surfaces.*.curvature"])) == [
        f"surfaces.{n}.curvature" for n in range(1, 7)
    ]
    assert len(triplet.variables(["surfaces.1.*", "surfaces.1.curvature"])) == 1


@pytest.mark.parametrize(
    ("pattern", "near"),
    [
        ("surfaces.1.curvatur", "surfaces.1.curvature"),
        ("sensor_distanc", "sensor_distance"),
        ("thickness.3", "thicknesses.3"),
    ],
)
def test_unknown_variables_name_near_ones(triplet, pattern, near):
    with pytest.raises(InputError, match=f"no parameter '{pattern}'; near: .*{near}") as error:
        triplet.variables(["sensor_distance", pattern])
    assert "\n" not in str(error.value)


def test_curvature_comes_from_the_radius(triplet):
    found = [float(p.detach()) for p in triplet.variables(["surfaces.*.curvature"]).values()]
    radii = [22.014, -435.760, -22.213, 20.292, 79.684, -18.395]
    assert found == [1 / r for r in radii]


def test_other_values_change_no_state(triplet, axial):
    before = {name: p.detach().clone() for name, p in triplet.named_parameters()}
    other = torch.tensor(50.0, dtype=torch.float64)
    system = triplet.system({"sensor_distance": other, "thicknesses.2": other})
    assert float(system.vertices[2].detach()) == pytest.approx(3.259 + 50.0)
    assert float(system.vertices[-1].detach()) == pytest.approx(17.969 - 6.008 + 100.0)
    for name, p in triplet.named_parameters():
        assert torch.equal(p, before[name])
    assert float(triplet.system().vertices[-1].detach()) == pytest.approx(60.177)
    with pytest.raises(InputError, match=r"no parameter 'surfaces\.1\.conic'"):
        triplet.system({"surfaces.1.conic": other})


def test_a_lens_with_other_values_is_that_lens_everywhere(triplet, axial):
    curvature = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    bent = triplet.with_values({"surfaces.1.curvature": curvature})
    stored = copy.deepcopy(triplet)
    with torch.no_grad():
        stored.surfaces["1"].curvature.fill_(0.05)
    assert torch.equal(bent.trace(axial).position, stored.trace(axial).position)
    (slope,) = torch.autograd.grad(bent.first_order(550.0).efl, curvature)
    exact = torch.autograd.grad(stored.first_order(550.0).efl, stored.surfaces["1"].curvature)
    assert torch.equal(slope, exact[0])
    # A later value takes the place of one before; the stored ones stay.
    moved = bent.with_values({"sensor_distance": torch.tensor(40.0, dtype=torch.float64)})
    assert set(moved.given) == {"surfaces.1.curvature", "sensor_distance"}
    before = triplet.trace(axial).position
    assert torch.equal(moved.as_stored().trace(axial).position, before)
    assert float(triplet.surfaces["1"].curvature) != 0.05


def test_gradients_reach_the_values_in_their_place(triplet):
    value = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    from dolens.optics.paraxial import first_order

    first_order(triplet.system({"surfaces.1.curvature": value}), 587.5618).efl.backward()
    assert float(value.grad) < 0.0
    assert all(p.grad is None for n, p in triplet.named_parameters() if n == "surfaces.1.curvature")


def test_copies_are_independent(triplet, axial):
    twin = copy.deepcopy(triplet)
    with torch.no_grad():
        twin.sensor_distance += 1.0
    assert float((twin.sensor_distance - triplet.sensor_distance).detach()) == pytest.approx(1.0)
    assert twin.materials == triplet.materials
    assert twin.stop == triplet.stop
    moved, still = twin.trace(axial), triplet.trace(axial)
    assert float((moved.position - still.position)[0, 2].detach()) == pytest.approx(1.0)
    expected = still.position[0, 0] + still.direction[0, 0] / still.direction[0, 2]
    assert float(moved.position[0, 0].detach()) == pytest.approx(float(expected.detach()))


def test_state_survives_a_round_trip(triplet, root, axial, tmp_path):
    with torch.no_grad():
        for p in triplet.parameters():
            p *= 1.001
    torch.save(triplet.state_dict(), tmp_path / "lens.pt")
    other = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml")
    other.load_state_dict(torch.load(tmp_path / "lens.pt", weights_only=True))
    assert torch.equal(other.trace(axial).position, triplet.trace(axial).position)


def test_precision_follows_the_lens(triplet, axial):
    exact = triplet.trace(axial).position
    single = triplet.to(torch.float32)
    assert single.dtype == torch.float32
    hit = single.trace(axial)
    for values in (hit.position, hit.direction, hit.path_length):
        assert values.dtype == torch.float32
    assert (hit.position.double() - exact).abs().max() < 1e-5
    assert single.first_order().efl.dtype == torch.float32


@pytest.mark.parametrize("lens_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("nm_dtype", [torch.float32, torch.float64])
def test_wavelengths_do_not_decide_the_precision(root, axial, lens_dtype, nm_dtype):
    """A float64 tensor of wavelengths used to promote a float32 trace."""
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", lens_dtype)
    # 512 nm is exact in both precisions, so the tensor and the number mean the same.
    nm = torch.tensor([512.0], dtype=nm_dtype)
    hit = lens.trace(Rays(axial.position, axial.direction, nm))
    alone = lens.trace(Rays(axial.position, axial.direction, 512.0))
    assert hit.position.dtype == lens_dtype
    limit = 1e-12 if lens_dtype == torch.float64 else 1e-5
    assert (hit.position - alone.position).abs().max() < limit


def test_calling_a_lens_traces(triplet, axial):
    assert torch.equal(triplet(axial).position, triplet.trace(axial).position)


def test_gaps_stay_in_order_beyond_nine_surfaces():
    """Gaps 1, 2, ..., 11 between twelve planes; as text 10 would sort before 2."""
    count = 12
    air = parse_material("air", index_model("dfc"))
    gaps = [float(n) for n in range(1, count)]
    lens = Lens([Plane(5.0, {}) for _ in range(count)], gaps, 100.0, [air] * (count + 1), stop=1)
    vertices = [float(z.detach()) for z in lens.system().vertices]
    assert vertices == [n * (n + 1) / 2 for n in range(count)] + [66.0 + 100.0]
    assert list(lens.variables(["thicknesses.*"])) == [f"thicknesses.{n}" for n in range(1, count)]
    state = {**lens.state_dict()}
    for twin in (copy.deepcopy(lens), lens.to(torch.float64)):
        twin.load_state_dict(state)
        assert [float(z.detach()) for z in twin.system().vertices] == vertices


def test_the_nikon_lens_is_as_long_as_its_table(root):
    lens = load_lens(root / "conf" / "lens" / "nikon.yaml")
    table = (0.102, 0.309, 0.246, 0.083, 0.411, 0.088, 0.258, 0.009, 0.379, 0.069, 0.118, 0.604,
             0.051, 0.009, 0.282, 0.239, 0.122, 0.154, 0.083, 0.750, 0.074)  # fmt: skip
    assert [float(gap.detach()) for gap in lens.system().thicknesses] == list(table)
    assert float(lens.system().vertices[-1].detach()) == pytest.approx(sum(table) + 0.043)


@pytest.mark.parametrize(
    ("gaps", "media", "stop", "said"),
    [
        ([], 3, 1, "2 surfaces need 1 thicknesses and 3 materials, not 0 and 3"),
        ([1.0], 2, 1, "2 surfaces need 1 thicknesses and 3 materials, not 1 and 2"),
        ([1.0], 3, 3, "stop must be a surface from 1 to 2, not 3"),
        ([1.0], 3, 0, "stop must be a surface from 1 to 2, not 0"),
    ],
)
def test_lenses_that_do_not_add_up(gaps, media, stop, said):
    air = parse_material("air", index_model("dfc"))
    surfaces = [Sphere(1.0, {"curvature": 0.1}) for _ in range(2)]
    with pytest.raises(InputError, match=re.escape(said)):
        Lens(surfaces, gaps, 1.0, [air] * media, stop)
