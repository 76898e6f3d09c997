"""Where pixels look, as polynomials, against a ray for each of them."""

from dataclasses import replace

import pytest
import torch
import yaml

from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.reference_sphere import chief_ray_intercepts
from dolens.prescriptions import lens_from_prescription
from dolens.rendering import chief_ray_map as module
from dolens.rendering.chief_ray_map import chief_ray_maps, fit_chief_ray_map
from dolens.rendering.exit_pupil import ExitPupil, axial_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import chief_ray_points
from dolens.rendering.protocol import SensorWindow
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)
SENSORS = {
    "large_fov_doublet": Sensor(300, 280, 0.12),
    "cooke_triplet": Sensor(200, 300, 0.09),
    "wavefront_coding": Sensor(96, 96, 0.02),
}


def lens_of(root, name):
    prescription = yaml.safe_load((root / f"conf/lens/{name}.yaml").read_text())
    return lens_from_prescription(prescription).double().requires_grad_(False)


def by_rays(system, scene, sensor, pupil):
    """Of each pixel its own chief ray."""
    row, column = torch.meshgrid(
        torch.arange(sensor.height).double(), torch.arange(sensor.width).double(), indexing="ij"
    )
    points = sensor.positions(row.reshape(-1), column.reshape(-1))
    seen = chief_ray_points(ImagingSystem(system, scene, sensor, pupil), points)
    return [c.permute(1, 2, 0).unflatten(-1, row.shape) for c in seen]


@pytest.mark.parametrize("name", SENSORS)
def test_polynomials_are_the_chief_rays_to_a_thousandth_of_a_pixel(root, name):
    system, sensor = lens_of(root, name).system(), SENSORS[name]
    scene = PlanarScene((5000.0, 9000.0), LINES)
    pupil = axial_exit_pupil(system, LINES)
    (found,) = chief_ray_maps(ImagingSystem(system, scene, sensor, pupil), [sensor])
    for one, other in zip(found, by_rays(system, scene, sensor, pupil), strict=True):
        assert float((one - other).abs().max()) < 1e-3


def test_windows_of_a_sensor_look_where_the_sensor_does(root):
    system, sensor = lens_of(root, "large_fov_doublet").system(), SENSORS["large_fov_doublet"]
    scene = PlanarScene((5000.0,), LINES)
    pupil = axial_exit_pupil(system, LINES)
    whole = fit_chief_ray_map(ImagingSystem(system, scene, sensor, pupil))
    window = sensor.window(11, 200, 40, 30)
    for part, all_of_it in zip(whole.of_window(window), whole.of_window(sensor), strict=True):
        assert torch.allclose(part, all_of_it[..., 11:51, 200:230], rtol=0, atol=1e-9)


def test_where_polynomials_are_not_enough_every_pixel_has_its_ray(root, monkeypatch):
    monkeypatch.setattr(module, "_SMALL", 0.0)
    system, sensor = lens_of(root, "cooke_triplet").system(), Sensor(12, 10, 1.0)
    scene = PlanarScene((5000.0,), LINES)
    pupil = axial_exit_pupil(system, LINES)
    assert fit_chief_ray_map(ImagingSystem(system, scene, sensor, pupil)) is None
    (found,) = chief_ray_maps(ImagingSystem(system, scene, sensor, pupil), [sensor])
    for one, other in zip(found, by_rays(system, scene, sensor, pupil), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("registration", ["chief_rays", "pinhole"])
@pytest.mark.parametrize("illumination", ["map", "functions"])
def test_windows_rendered_together_are_those_rendered_one_by_one(root, registration, illumination):
    """But for the pupil's disc, which serves the whole sensor; here it is the axial one."""
    lens, sensor = lens_of(root, "wavefront_coding"), Sensor(120, 120, 0.0069)
    scene = PlanarScene((5000.0, 9000.0), LINES)
    generator = torch.Generator().manual_seed(3)
    textures = torch.rand(2, 3, 64, 64, generator=generator, dtype=torch.float64)
    windows = [sensor.window(0, 5, 32, 32), sensor.window(80, 40, 32, 32)]
    centres = [(window.centre_row, window.centre_column) for window in windows]
    settings = {
        "fields": (2, 2),
        "size": 31,
        "registration": registration,
        "illumination": illumination,
        "jitter": False,
    }
    shown = [SensorWindow(*pair) for pair in zip(windows, centres, strict=True)]
    together = PsfRenderer(sensor, **settings).render_windows(lens, scene, textures, shown, 1)
    for i, window in enumerate(windows):
        placed = PlanarScene(scene.depths, scene.wavelengths, centres[i])
        alone = PsfRenderer(window, **settings).render(lens, placed, textures[i : i + 1], 1)
        assert together[i].shape == alone[0].shape
        assert torch.allclose(together[i], alone[0], rtol=0, atol=2e-4)


def test_where_rays_through_the_paraxial_pupil_do_not_pass_those_through_the_stop_serve(root):
    """Rays forwards from the points that they find, aimed by other code, come back to pixels."""
    lens = lens_of(root, "phone").requires_grad_(True)
    system, sensor = lens.system(), Sensor(300, 300, 0.018)
    scene = PlanarScene((1000.0,), (587.5618,))
    # Rays towards a pupil just before the sensor are reflected totally.
    pupil = ExitPupil(float(system.vertices[-1]) - 0.2, 0.1, 0.1)
    x, y = torch.tensor([0.0, 1.5, 2.7, 0.0]).double(), torch.tensor([0.0, 1.0, 2.7, 3.0]).double()
    imaging = ImagingSystem(system, scene, sensor, pupil)
    rows, columns = (c[:, 0, 0] for c in chief_ray_points(imaging, (x, y)))
    (magnification,) = scene.magnifications(system)
    scale = sensor.pixel_pitch / magnification
    places = torch.stack((columns * scale, -rows * scale, torch.full_like(x, -1000.0)), -1)
    lines = torch.full_like(x, 587.5618)
    landed = chief_ray_intercepts(system, ObjectPoints.at(places.detach()), lines)
    assert torch.allclose(landed, torch.stack((x, y), -1), rtol=0.0, atol=1e-9)
    # The image moves with the lens: against a difference.
    value = lens.surfaces["9"].curvature
    (slope,) = torch.autograd.grad(rows[2], value)
    moved = []
    with torch.no_grad():
        for step in (1e-6, -2e-6):
            value.add_(step)
            now = replace(imaging, system=lens.system())
            moved.append(float(chief_ray_points(now, (x, y))[0][2, 0, 0]))
    assert float(slope) == pytest.approx((moved[0] - moved[1]) / 2e-6, rel=1e-5)
