"""What a test measures: by rays, by other judges, with wrong calibrations, by exposure."""

import math

import pytest
import torch

from dolens.experiments.camera.calibration import NoisyMeasurement, OtherDepth, OtherSample
from dolens.optics import ray_tracing
from dolens.rendering.psf import axial_point_spread_functions
from tests.experiments.tiny_experiment import CAMERA, ONE_EPOCH, UNPICTURED
from tests.pretended_gpu import PretendedGpu

JUDGED = [*CAMERA, ONE_EPOCH, UNPICTURED, "reference_renderers=wave", "miscalibrations=wrong"]
KINDS = ("depth", "tolerances", "noise")


def test_a_run_is_judged_by_waves_and_with_wrong_calibrations_too(trained):
    found = trained(*JUDGED)
    metrics = found.metrics
    depths = ("8m", "6m", "4.5m")
    for name in ("test_wave/psnr_db", "test_wave/ssim", "val_wave/psnr_db"):
        assert metrics[f"{name}/worst"] == min(metrics[f"{name}/{depth}"] for depth in depths)
    for kind in KINDS:
        name = f"test/psnr_db_miscalibrated/{kind}"
        assert metrics[f"{name}/worst"] == min(metrics[f"{name}/{depth}"] for depth in depths)
        assert metrics[name] != metrics["test/psnr_db"]
        assert f"val/psnr_db_miscalibrated/{kind}" not in metrics
    assert metrics["test_wave/psnr_db"] != metrics["test/psnr_db"]
    assert metrics["cost/judge_wave_s"] > 0
    assert metrics["error/test_wave/psnr_db/worst/low"] <= metrics["test_wave/psnr_db/worst"]
    # The table's mean over photographs is the metric.
    rows = found.table("test_wave_photographs")
    mean = [float(row["psnr_db"]) for row in rows if row["view"] == "8m"]
    assert sum(mean) / len(mean) == pytest.approx(metrics["test_wave/psnr_db/8m"], rel=1e-5)


def test_a_judge_that_is_the_evaluation_renderer_says_the_same_to_the_bit(trained):
    """Behind a network without functions, which has no calibration to go wrong."""
    same = (
        "reference_renderers={again: {_target_: dolens.rendering.ray_renderer.RayRenderer, "
        "sensor: '${renderer.sensor}', pupil_samples: 2}}"
    )
    metrics = trained(*JUDGED, "reference_renderers=none", f"++{same}", "network=unet").metrics
    for name in ("psnr_db", "ssim", "raw_psnr_db/worst"):
        assert metrics[f"test_again/{name}"] == metrics[f"test/{name}"]
    assert not any("miscalibrated" in name for name in metrics)


def test_wrong_calibrations_are_wrong_in_what_they_say(made):
    module = made(*JUDGED)
    lens = module.lens
    values = {name: value.detach() for name, value in module.variables().items()}
    views = module.views
    exact = views.point_spread_functions(lens.with_values(values))
    generator = torch.Generator().manual_seed(0)

    def found(calibration):
        return calibration.functions(views, lens.with_values(values), exact, generator)

    # Of the scene's own third depth: that function and no other.
    (nearest,) = found(OtherDepth(4500.0))
    assert torch.allclose(nearest, exact[2], atol=1e-6)
    far = type(views.scene)((20000.0,), views.scene.wavelengths)
    beyond = axial_point_spread_functions(lens.with_values(values), far, views.sensor, 33, 8)
    assert torch.allclose(found(OtherDepth(20000.0)), beyond, atol=1e-6)
    # A sensor that stands 0.3 mm off at most moves the functions; one 1e-9 mm off does not.
    off = OtherSample({"sensor_distance": 0.3})
    first, second = found(off), found(off)
    assert float((first - exact).abs().max()) > 1e-3
    assert float((first - second).abs().max()) > 1e-3  # another sample
    assert torch.allclose(found(OtherSample({"sensor_distance": 1e-9})), exact, atol=1e-5)
    # Counting noise falls as one over the root of the electrons.
    few, many = (
        float((found(NoisyMeasurement(electrons)) - exact).square().mean().sqrt())
        for electrons in (1e3, 1e5)
    )
    assert few / many == pytest.approx(10.0, rel=0.1)


def test_a_tolerance_that_the_lens_does_not_have_is_refused(refused):
    refused(
        "no parameter 'surfaces.9.curvature'",
        *JUDGED,
        "++miscalibrations.tolerances.tolerances={surfaces.9.curvature: 0.1}",
    )


def test_stopping_down_by_a_stop_halves_the_electrons(made):
    def readout(semi_diameter, *more):
        stop = f"++lens.surfaces.1.semi_diameter={semi_diameter}"
        return made(*JUDGED, stop, *more).views.readout

    ratio = readout(6.0).relative_exposure / readout(6.0 / math.sqrt(2.0)).relative_exposure
    # As 4N² - 1 doubles, and not 4N² itself.
    assert ratio == pytest.approx(2.0, rel=0.01)
    without = readout(3.0, "readout.reference_f_number=null")
    assert without.relative_exposure == without.exposure


def test_the_network_s_functions_have_a_perfect_pupil_s_diffraction_where_asked(made):
    sharp, blurred = (
        m.views.point_spread_functions(m.lens.with_values(m.variables())).detach()
        for m in (made(*JUDGED), made(*JUDGED, "views.psf_diffraction=limit"))
    )
    assert torch.allclose(sharp.sum((-2, -1)), blurred.sum((-2, -1)), rtol=1e-4)
    # The Airy disc widens a function's second moment.
    x = torch.arange(33.0) - 16.0
    square = x[:, None] ** 2 + x[None, :] ** 2
    assert bool(((blurred * square).sum((-2, -1)) > (sharp * square).sum((-2, -1))).all())


def test_a_camera_is_scored_on_a_gpu_as_on_the_cpu(made, monkeypatch):
    """Its network, by rays and waves, with wrong calibrations, and its untrained rivals."""
    monkeypatch.setattr(ray_tracing, "without_triton", lambda: "the GPU is pretended")

    def scored(device):
        torch.manual_seed(0)
        camera = made(*JUDGED).to(device)
        camera.views.prepare(camera.lens)
        batch = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1))
        camera.evaluation.measure(camera, batch.to(device), "test", 0)
        rows = camera.evaluation._rows.items()
        return {(stage, name): found[0] for stage, row in rows for name, found in row.items()}

    expected = scored("cpu")
    with PretendedGpu():
        found = scored("cuda")
    assert {("test", "tv_psnr_db"), ("test_wave", "psnr_db")} < set(expected)
    assert found.keys() == expected.keys()
    # dB: rays of single precision round otherwise without kernels, and on each processor.
    for name, scores in expected.items():
        assert torch.allclose(found[name], scores, atol=5e-3), name
