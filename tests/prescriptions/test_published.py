"""Lenses from patents and books give the focal length, F-number and field of their sources."""

import math

import pytest
import torch
import yaml

from dolens import InputError, Rays, Status, load_lens, save_lens
from dolens.optics.published import Published
from dolens.prescriptions import (
    lens_from_prescription,
    load_prescription,
    prescription_of,
    published_lens_names,
)
from tests.prescriptions.samples import SINGLET

NAMES = published_lens_names()
# Just inside the stop's edge, where light passes: up, down and across.
EDGE = 0.9999
PASSED = int(Status.OK)


@pytest.fixture(scope="module")
def lenses():
    """Each lens is loaded once."""
    return {name: load_lens(name) for name in NAMES}


def short(name):
    return name.partition("/")[2]


def test_there_are_at_least_forty_with_focal_length_aperture_and_field(lenses):
    whole = [
        lens.published
        for lens in lenses.values()
        if lens.published.efl
        and (lens.published.f_number or lens.published.entrance_pupil_diameter)
        and (lens.published.half_field or lens.published.image_height)
    ]
    assert len(whole) >= 40


@pytest.mark.parametrize("name", NAMES, ids=short)
def test_numbers_are_those_that_the_source_prints(name, lenses):
    lens, published = lenses[name], lenses[name].published
    assert lens.source and published.kind
    first = lens.first_order(lens.primary_wavelength, lens.object_distance)
    if published.efl is not None:
        assert 0.0 < published.efl_tolerance <= 0.0100001 * published.efl
        # Behind an intermediate image the sign is negative.
        assert abs(float(first.efl)) == pytest.approx(published.efl, abs=published.efl_tolerance)
    if published.f_number is not None:
        assert abs(float(first.f_number)) == pytest.approx(published.f_number, rel=0.02)
    if published.entrance_pupil_diameter is not None:
        diameter = float(first.entrance_pupil.diameter)
        assert diameter == pytest.approx(published.entrance_pupil_diameter, rel=0.02)
    if published.magnification is not None:
        assert float(first.magnification) == pytest.approx(published.magnification, rel=0.01)
    if published.half_field is not None:
        assert lens.fields.kind == "angles"
        largest = max(math.hypot(*point) for point in lens.fields.points)
        assert largest == pytest.approx(published.half_field, rel=1e-6)


@pytest.mark.parametrize("name", NAMES, ids=short)
def test_light_of_the_axis_and_of_the_edge_of_the_field_arrives(name, lenses):
    lens = lenses[name]
    wave, distance = lens.primary_wavelength, lens.object_distance
    rim = EDGE * torch.tensor([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]])
    marginal = lens.aim((0.0, 0.0), rim, wave, distance)
    field = max(lens.fields.points, key=lambda point: math.hypot(*point))
    chief = lens.chief_ray(field, wave, distance)
    for aimed in (marginal, chief):
        assert bool(aimed.converged.all())
        arrived = lens.trace(Rays(aimed.position, aimed.direction, wave))
        lost = set(arrived.status.flatten().tolist())
        obscured = any(s.aperture.obscuration for s in lens.surfaces.values())
        allowed = {PASSED, int(Status.VIGNETTED)} if aimed is chief and obscured else {PASSED}
        assert lost <= allowed


@pytest.mark.parametrize("name", NAMES, ids=short)
def test_yaml_gives_back_the_lens_and_what_is_published(name, lenses):
    lens = lenses[name]
    again = lens_from_prescription(yaml.safe_load(yaml.safe_dump(prescription_of(lens))))
    before, after = dict(lens.named_parameters()), dict(again.named_parameters())
    assert before.keys() == after.keys()
    assert all(torch.equal(before[n], after[n]) for n in before)
    assert (again.source, again.published) == (lens.source, lens.published)


def test_published_numbers_stay_in_yaml_and_out_of_other_formats(tmp_path):
    lens = lens_from_prescription(SINGLET | {"published": {"kind": "singlet", "efl": 100}})
    assert lens.published == Published(kind="singlet", efl=100.0)
    save_lens(lens, tmp_path / "lens.yaml")
    assert load_lens(tmp_path / "lens.yaml").published == lens.published
    save_lens(lens, tmp_path / "lens.txt")
    assert load_lens(tmp_path / "lens.txt").published is None


@pytest.mark.parametrize(
    ("published", "said"),
    [
        ([100], "published: expected a mapping"),
        ({"focal_length": 100}, "published: unknown key 'focal_length'"),
        ({"efl": "long"}, "published: 'efl' must be a number, not 'long'"),
        ({"f_number": -2}, "published: 'f_number' must be positive, not -2"),
        ({"kind": 3}, "published: 'kind' must be text, not 3"),
    ],
)
def test_a_mistake_takes_one_line(published, said):
    with pytest.raises(InputError, match=f"^lens: {said}") as refusal:
        lens_from_prescription(SINGLET | {"published": published})
    assert "\n" not in str(refusal.value)


def test_a_name_with_a_typing_error_is_answered_with_a_near_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="did you mean 'published/tessar_us2838978'"):
        load_prescription("published/tessar_us283897")
