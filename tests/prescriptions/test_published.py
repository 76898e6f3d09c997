"""Lenses from patents and books give the focal length, F-number and field of their sources."""

import functools
import math

import pytest
import torch

from dolens import InputError, Rays, Status, load_lens, save_lens
from dolens.optics.lens_data import Published
from dolens.prescriptions import (
    lens_from_prescription,
    load_prescription,
    prescription_of,
    published_lens_names,
)
from tests.prescriptions.samples import SINGLET, require_same_parameters
from tests.refused import refused

NAMES = published_lens_names()
# Just inside the stop's edge, where light passes: up, down and across.
EDGE = 0.9999
RIM = ((0.0, EDGE), (0.0, -EDGE), (EDGE, 0.0))


# Of every kind one, loaded as a user loads it; the others are built without automatic sizes.
WHOLE = (
    "published/tessar_us2838978",
    "published/camera_us8427765_ex1",
    "published/litho_us5831776",
    "published/fisheye_us5949588_t8",
    "published/telephoto_smith_p175_sigler",
)


@functools.cache
def built(name):
    """A lens whose automatic semi-diameters, which clip nothing, are not searched for: it is built
    in a tenth of the time."""
    prescription = load_prescription(name)
    rows = {str(n): dict(row) for n, row in prescription["surfaces"].items()}
    # A length of the size of the lens, which sets the scale of tolerances.
    gaps = [abs(row.get("thickness", 0.0)) for row in rows.values()]
    size = 0.05 * (sum(gaps) + abs(prescription["sensor"]["distance"]))
    for n, row in rows.items():
        if row.get("semi_diameter") == "auto" and n != str(prescription["stop"]):
            row |= {"semi_diameter": size, "clips": False}
    return lens_from_prescription(prescription | {"surfaces": rows}, where=name)


def short(name):
    return name.partition("/")[2]


def test_there_are_at_least_forty_with_focal_length_aperture_and_field():
    found = [load_prescription(name)["published"] for name in NAMES]
    whole = [
        published
        for published in found
        if "efl" in published
        and ("f_number" in published or "entrance_pupil_diameter" in published)
        and ("half_field" in published or "image_height" in published)
    ]
    assert len(whole) >= 40


@pytest.mark.parametrize("name", NAMES, ids=short)
def test_numbers_are_those_that_the_source_prints(name):
    lens, published = built(name), built(name).published
    assert lens.source and published.kind
    with torch.no_grad():
        first = lens.first_order(lens.primary_wavelength, lens.object_distance)
    if published.efl is not None:
        assert 0.0 < published.efl_tolerance <= 0.0100001 * published.efl
        # Behind an intermediate image the sign is negative.
        assert abs(float(first.efl)) == pytest.approx(published.efl, abs=published.efl_tolerance)
    if published.f_number is not None:
        assert abs(float(first.f_number)) == pytest.approx(published.f_number, rel=1e-3)
    if published.entrance_pupil_diameter is not None:
        diameter = float(first.entrance_pupil.diameter)
        assert diameter == pytest.approx(published.entrance_pupil_diameter, rel=1e-3)
    if published.magnification is not None:
        assert float(first.magnification) == pytest.approx(published.magnification, rel=1e-3)
    if published.half_field is not None:
        assert lens.fields.kind == "angles"
        largest = max(math.hypot(*point) for point in lens.fields.points)
        assert largest == pytest.approx(published.half_field, rel=1e-9)


WITH_STATES = [
    (name, state) for name in NAMES for state in load_prescription(name).get("states", {})
]


@pytest.mark.parametrize(
    ("name", "state"), WITH_STATES, ids=[f"{short(name)}-{state}" for name, state in WITH_STATES]
)
def test_every_position_of_a_zoom_has_its_focal_length_and_its_image(name, state):
    lens = built(name).in_state(state)
    published = lens.published
    with torch.no_grad():
        first = lens.first_order(lens.primary_wavelength, lens.object_distance)
        # The gaps put the paraxial image on the sensor, but for their rounding.
        image = float(first.image - lens.system().vertices[len(lens.surfaces) - 1])
    if published.efl is not None:
        assert 0.0 < published.efl_tolerance <= 0.01 * published.efl
        assert float(first.efl) == pytest.approx(published.efl, abs=published.efl_tolerance)
    if published.f_number is not None:
        assert float(first.f_number) == pytest.approx(published.f_number, rel=1e-9)
    depth = 2.0 * abs(float(first.working_f_number))
    assert image == pytest.approx(float(lens.sensor_distance), abs=0.05 * depth)


def test_a_focused_telephoto_has_its_image_where_its_patent_has_it():
    """Printed gaps at 2.5 m: the image stays within a thousandth of a millimetre."""
    lens = built("published/internal_focus_jph04294310_ex1")
    images = []
    for state in ("far", "near"):
        there = lens.in_state(state)
        with torch.no_grad():
            images.append(float(there.first_order(object_distance=there.object_distance).image))
    assert images[0] == pytest.approx(images[1], abs=1e-3)


@pytest.mark.parametrize("name", NAMES, ids=short)
def test_light_of_the_axis_and_of_the_edge_of_the_field_arrives(name):
    lens = built(name)
    wave, distance = lens.primary_wavelength, lens.object_distance
    field = max(lens.fields.points, key=lambda point: math.hypot(*point))
    fields = torch.tensor([(0.0, 0.0)] * len(RIM) + [field])
    # Marginal rays of the axis, and the chief ray of the edge of the field.
    aimed = lens.aim(fields, torch.tensor([*RIM, (0.0, 0.0)]), wave, distance)
    assert bool(aimed.converged.all())
    arrived = lens.trace(Rays(aimed.position, aimed.direction, wave))
    *marginal, chief = arrived.status.tolist()
    assert set(marginal) == {int(Status.OK)}
    # A hole in a mirror takes the chief ray, and no ray of the edge of the pupil.
    obscured = any(surface.aperture.obscuration for surface in lens.surfaces.values())
    assert chief == int(Status.OK) or (obscured and chief == int(Status.VIGNETTED))


@pytest.mark.parametrize("name", NAMES, ids=short)
def test_a_lens_gives_back_its_prescription(name):
    lens = built(name)
    again = lens_from_prescription(prescription_of(lens))
    require_same_parameters(lens, again)
    assert (again.source, again.published) == (lens.source, lens.published)
    assert (again.fields, again.wavelengths) == (lens.fields, lens.wavelengths)


@pytest.mark.parametrize("name", WHOLE, ids=short)
def test_a_file_goes_around_through_yaml(name, tmp_path):
    lens = load_lens(name)
    sizes = [surface.semi_diameter for surface in lens.surfaces.values()]
    assert all(0.0 < size < math.inf for size in sizes)
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    require_same_parameters(lens, again)
    assert sizes == [surface.semi_diameter for surface in again.surfaces.values()]
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
    with refused("", f"lens: {said}"):
        lens_from_prescription(SINGLET | {"published": published})


def test_a_name_with_a_typing_error_is_answered_with_a_near_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="did you mean 'published/tessar_us2838978'"):
        load_prescription("published/tessar_us283897")
