"""A path says surface by surface where a ray goes, and names the true reason of its end."""

import math

import pytest
import torch

from dolens import InputError, Rays, Status, load_lens
from dolens.analysis.ray_path import ray_path
from tests.optics.test_coordinate_breaks import newtonian


def ray(y, slope=0.0, z=-5.0, wavelength=587.5618):
    direction = torch.tensor([0.0, math.sin(slope), math.cos(slope)], dtype=torch.float64)
    return Rays(torch.tensor([0.0, y, z], dtype=torch.float64), direction, wavelength)


@pytest.mark.parametrize("name", ["cooke_triplet", "nikon", "wavefront_coding", "phone"])
def test_a_path_ends_as_the_trace_does_and_passes_its_points(name):
    lens = load_lens(name, dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    reach = 1.3 * lens.surfaces["1"].semi_diameter
    ends = set()
    for _ in range(40):
        y, slope = (2.0 * torch.rand(2, generator=generator) - 1.0).tolist()
        given = ray(reach * y, 0.8 * slope)
        traced = lens.trace(given, record=True)
        found = lens.explain(given)
        assert found.status == int(traced.status)
        ends.add(found.status)
        number = int(traced.surface)
        assert found.ending.startswith(
            f"surface {number}:" if 0 < number <= len(lens.surfaces) else ("the ray", "sensor")
        )
        for crossing, point in zip(found.crossings, traced.points, strict=False):
            if traced.valid:
                assert crossing.point == pytest.approx(point.tolist(), abs=1e-9)
    assert Status.OK in ends and len(ends) > 1


def test_a_path_follows_mirrors_and_coordinate_breaks():
    telescope = newtonian()
    given = ray(80.0, z=-900.0)
    traced = telescope.trace(given, record=True)
    found = telescope.explain(given)
    assert found.status == Status.OK and [c.surface for c in found.crossings] == [
        *(
            f"{n} {s.kind}"
            for n, s in enumerate(telescope.surfaces.values(), 1)
            if not s.changes_axes
        ),
        "sensor",
    ]
    met = [p for p, s in zip(traced.points, telescope.surfaces.values(), strict=True)
           if not s.changes_axes]  # fmt: skip
    for crossing, point in zip(found.crossings, [*met, traced.position], strict=True):
        assert crossing.point == pytest.approx(point.tolist(), abs=1e-9)


def test_total_reflection_names_the_critical_angle():
    triplet = load_lens("cooke_triplet", dtype=torch.float64)
    found = ray_path(triplet, ray(14.0))
    assert found.status == Status.TIR
    index = float(triplet.system().indices(587.5618)[3])
    critical = math.degrees(math.asin(1.0 / index))
    assert f"beyond the critical angle {critical:.3f}°" in found.ending
    assert found.crossings[-1].incidence > critical


def test_each_reason_of_a_miss_has_its_own_words():
    triplet, phone = (load_lens(n, dtype=torch.float64) for n in ("cooke_triplet", "phone"))
    # The first sphere has a radius of 22 mm; a steep ray passes beside the flint's back.
    assert (
        "40.0000 mm from the axis, beyond the end of the sag" in triplet.explain(ray(40.0)).ending
    )
    assert "surface 4: missed: the ray passes beside" in triplet.explain(ray(9.0, -0.9)).ending
    assert "away from it" in triplet.explain(ray(0.0, math.pi)).ending
    # An asphere far outside its aperture runs away from the ray.
    far = ray(6.0 * phone.surfaces["1"].semi_diameter)
    assert "Newton's iteration found no" in phone.explain(far).ending


def test_a_path_is_that_of_one_ray():
    with pytest.raises(InputError, match="of one ray, not of 2"):
        load_lens("cooke_triplet").explain(Rays(torch.zeros(2, 3), torch.eye(3)[2]))


def test_a_path_shows_itself_as_text_and_html():
    found = load_lens("cooke_triplet", dtype=torch.float64).explain(ray(3.0))
    lines = repr(found).splitlines()
    assert lines[0] == "Cooke triplet: a ray of 587.562 nm" and lines[-1] == found.ending
    assert len(lines) == 2 + 7 + 1
    assert found._repr_html_().count("<tr>") == 8
