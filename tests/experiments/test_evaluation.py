"""What a test measures: by rays, by other judges, with wrong calibrations, by exposure."""

import csv
import json
import math

import pytest
import torch
from hydra.utils import instantiate
from tiny_experiment import TINY, TINY_NETWORK

from dolens.experiments.camera.calibration import NoisyMeasurement, OtherDepth, OtherSample
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens, run
from dolens.rendering.psf import axial_point_spread_functions

QUICK = ["trainer.max_epochs=1", "callbacks.pictures=null"]
JUDGED = ["reference_renderers=wave", "miscalibrations=wrong"]
WAVEFRONT_CODING = ["experiment=wavefront_coding", *TINY, *TINY_NETWORK, *QUICK, *JUDGED]
KINDS = ("depth", "tolerances", "noise")


def metrics_of(tmp_path, folder="run"):
    return json.loads((tmp_path / folder / "metrics.json").read_text())


def camera(composed, *overrides):
    cfg = composed(*WAVEFRONT_CODING, *overrides)
    lens = build_lens(RunSettings.of(cfg))
    return lens, instantiate(cfg.module)(lens=lens)


def test_a_run_is_judged_by_waves_and_with_wrong_calibrations_too(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING))
    metrics = metrics_of(tmp_path)
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
    with (tmp_path / "run/test_wave_photographs.csv").open() as file:
        rows = list(csv.DictReader(file))
    # The table's mean over photographs is the metric.
    mean = [float(row["psnr_db"]) for row in rows if row["view"] == "8m"]
    assert sum(mean) / len(mean) == pytest.approx(metrics["test_wave/psnr_db/8m"], rel=1e-5)


def test_a_judge_that_is_the_evaluation_renderer_says_the_same_to_the_bit(composed, tmp_path):
    same = (
        "reference_renderers={again: {_target_: dolens.rendering.ray_renderer.RayRenderer, "
        "sensor: '${renderer.sensor}', pupil_samples: 2}}"
    )
    run(composed(*WAVEFRONT_CODING, "reference_renderers=none", f"++{same}"))
    metrics = metrics_of(tmp_path)
    for name in ("psnr_db", "ssim", "raw_psnr_db/worst"):
        assert metrics[f"test_again/{name}"] == metrics[f"test/{name}"]


def test_a_network_without_functions_has_no_calibration_to_go_wrong(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING, "network=unet"))
    assert not any("miscalibrated" in name for name in metrics_of(tmp_path))


def test_wrong_calibrations_are_wrong_in_what_they_say(composed):
    lens, module = camera(composed)
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
        *WAVEFRONT_CODING,
        "++miscalibrations.tolerances.tolerances={surfaces.9.curvature: 0.1}",
    )


def test_stopping_down_by_a_stop_halves_the_electrons(composed):
    stopped = "+lens.surfaces.1.semi_diameter"
    _, full = camera(composed, "++lens.surfaces.1.semi_diameter=6.0")
    _, stop = camera(composed, f"+{stopped}={6.0 / math.sqrt(2.0)}")
    ratio = full.views.readout.relative_exposure / stop.views.readout.relative_exposure
    # As 4N² - 1 doubles, and not 4N² itself.
    assert ratio == pytest.approx(2.0, rel=0.01)
    _, without = camera(composed, "readout.reference_f_number=null", f"+{stopped}=3.0")
    assert without.views.readout.relative_exposure == without.views.readout.exposure


def test_the_network_s_functions_have_a_perfect_pupil_s_diffraction_where_asked(composed):
    lens, rays = camera(composed)
    _, waves = camera(composed, "views.psf_diffraction=limit")
    sharp, blurred = (
        m.views.point_spread_functions(lens.with_values(m.variables())).detach()
        for m in (rays, waves)
    )
    assert torch.allclose(sharp.sum((-2, -1)), blurred.sum((-2, -1)), rtol=1e-4)
    # The Airy disc widens a function's second moment.
    x = torch.arange(33.0) - 16.0
    square = x[:, None] ** 2 + x[None, :] ** 2
    assert bool(((blurred * square).sum((-2, -1)) > (sharp * square).sum((-2, -1))).all())
