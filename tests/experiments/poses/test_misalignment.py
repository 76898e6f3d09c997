"""The five fits of Section VI, at a size that takes seconds."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.alignment.measurement import Measurement
from dolens.experiments.poses.fit_plan import blur_for, spot_imager, values_imager
from dolens.sensor.pixels import Sensor
from tests.experiments.runs import same_to_the_bit
from tests.experiments.tiny_experiment import QUIET, UNPICTURED

TINY = [
    "experiment=misalignment",
    "~fits.10",
    "~fits.25",
    "~fits.30",
    "sensor.height=32",
    "sensor.width=32",
    "sensor.pixel_pitch=0.2208",
    "photons=100000",
    "imager.rays=10000",
    "monte_carlo=0",
    QUIET,
    UNPICTURED,
]
SHORT = [
    "stages=[{optimizer: adam, iterations: 2},{optimizer: dls, iterations: 2},"
    "{optimizer: dls, iterations: 2, loss: noise_weighted, imager: {rim: 0.005}}]",
]


def test_poses_are_found_and_what_was_found_first_is_held(trained):
    """From Figure 8's initial values to its truth, then the lens's own pose."""
    first, second = (
        "{optimizer: adam, iterations: 40, learning_rate: 0.2}",
        "{optimizer: dls, iterations: 12}",
    )
    found = trained(*TINY, f"stages=[{first},{second}]")
    metrics, rows = found.metrics, found.table("poses")
    assert len(rows) == 11
    for row in rows:
        initial = abs(float(row["initial"]) - float(row["true"]))
        error = abs(float(row["error"]))
        # Everything that began far off is found, or is as near as can be known.
        assert error < max(0.25 * initial, 10.0 * float(row["bound"])), row
        name = f"pose_error/{row['fit']}/{row['variable']}"
        assert metrics[name] == pytest.approx(error, rel=1e-4)
        assert metrics[f"pose_bound/{row['fit']}/{row['variable']}"] > 0.0
    history = found.table("history")
    assert len(history) == 104
    for row in history:
        terms = float(row["loss/image"]) + float(row["loss/centroid"])
        assert float(row["loss"]) == pytest.approx(terms, rel=1e-9)
    assert metrics["pose_error/over_bound"] < 30.0


def test_a_resumed_run_ends_with_the_same_poses_to_the_bit(trained):
    """Within a stage of Adam, within least squares of either kind, and within the second fit."""
    settings = [*TINY, *SHORT, "test=false", "objective=train/loss", "imager.rays=1000"]
    each = ["callbacks.last.every_n_train_steps=1", "+callbacks.last.save_top_k=-1"]
    steps = trained(*settings, *each, "callbacks.last.filename='{step}'", folder="steps").last
    whole = trained(*settings, folder="whole").state
    for stop in (1, 3, 5, 8):
        last = f"ckpt_path='{steps.with_name(f'step={stop}.ckpt')}'"
        again = trained(*settings, last, folder=f"resumed_{stop}")
        assert same_to_the_bit(whole, again.state), stop


def test_a_stage_may_move_some_variables_only(trained):
    stages = "stages=[{optimizer: dls, iterations: 2, variables: [elements.lens.tilt_x]}]"
    rows = trained(*TINY, "~fits.5", stages).table("poses")
    found = {row["variable"]: row for row in rows}
    moved = {n for n, row in found.items() if float(row["found"]) != float(row["initial"])}
    assert moved == {"elements.lens.tilt_x"}


def stage(more):
    return f"stages=[{{optimizer: dls, iterations: 1, {more}}}]"


BAD_SETTINGS = {
    "stages=[{optimizer: lbfgs, iterations: 2}]": "'lbfgs' is unknown (allowed: adam, dls",
    "stages=[{optimizer: dls, iterations: 0}]": "0 iterations",
    stage("variables: [focus]"): "variable of fit 0: 'focus' is unknown",
    stage("loss: l1"): "loss: 'l1' is unknown (allowed: s21",
    stage("imager: {ray: 2}"): "imager: ",
    stage("loss: noise_weighted, centroid_weight: 1.0"): "centroid_weight is of loss s21",
    stage("noise_blur: 2.0"): "noise_blur is of loss noise_weighted",
    stage("loss: noise_weighted, noise_blur: -1.0"): "stages: noise_blur: -1.0; allowed",
    "fits.5.held.from='30'": "fits.5.held.from: '30' is no earlier fit; allowed: 0",
    "+fits.5.start=1": "fits.5: unknown key 'start'",
    "+fits.5.truth.focus=1": "focus",
    "lens_dtype=float32": "poses are fitted in float64",
}


@pytest.mark.parametrize("override", BAD_SETTINGS)
def test_bad_settings_are_errors(refused, override):
    refused(BAD_SETTINGS[override], *TINY, override)


def test_a_photograph_is_fitted_without_a_truth(trained, tmp_path):
    """Its pixels, its region and its dark level; errors cannot be told, bounds can."""
    rows, columns = np.mgrid[:256, :256]
    spot = 20000.0 * (np.hypot(rows - 128.0, columns - 120.0) < 40.0)
    Image.fromarray((spot + 500.0).astype(np.uint16)).save(tmp_path / "spot.tif")
    photograph = (
        f"measurement={{path: {tmp_path / 'spot.tif'}, pixel_pitch: 0.0276, dark_level: 500, "
        "downsample: 8}"
    )
    objective = "objective=pose_bound/0/sensor_distance"
    metrics = trained(*TINY, *SHORT, "~fits.5", photograph, objective).metrics
    assert math.isfinite(metrics["pose/0/sensor_distance"])
    assert metrics["pose_bound/0/sensor_distance"] > 0.0
    assert not any(name.startswith("pose_error") for name in metrics)


@pytest.mark.parametrize(("blur", "finds"), [(4.0, True), (0.0, False)])
def test_three_planes_tell_bench_and_lens_at_once(trained, blur, finds):
    """Eight numbers of which one image knows a combination ten times worse, from 10 % and 4° off.

    Weighted by the noise of the model's own light, dark pixels keep it where it is; by that of the
    light within four pixels it finds its way.
    """
    # On coarser pixels what goes astray soon meets no light at all, which is an error.
    side, first = (32, 8) if finds else (64, 5)
    wide = f"{{optimizer: dls, iterations: {first}, loss: noise_weighted, noise_blur: {blur}}}"
    found = trained(
        "experiment=misalignment_planes",
        *(f"sensor.height={side}", f"sensor.width={side}", f"sensor.pixel_pitch={7.0656 / side}"),
        *(f"imager.rays={250 * side}", "monte_carlo=0", f"stages=[{wide}]", QUIET),
    )
    rows = found.table("poses")
    assert len(rows) == 8
    ratios = [abs(float(row["error"])) / float(row["bound"]) for row in rows]
    assert (max(ratios) < 6.0) if finds else (max(ratios) > 100.0)
    assert all(float(row["bound"]) == float(row["own_bound"]) for row in rows)
    assert found.figures == {"spots", "convergence_10", "corner_10"}


def test_patches_of_light_are_as_narrow_as_rays_are_dense():
    """Of a measured disc of 100 pixels: rays that pass, over them, are 1.2 patches apart."""
    image = torch.zeros(1, 32, 32, dtype=torch.float64)
    image[0, 10:20, 10:20] = 7.0
    measured = Measurement(
        image, torch.ones_like(image, dtype=torch.bool), 0.0, Sensor(32, 32, 0.1)
    )
    assert float(measured.lit_pixels) == pytest.approx(100.0)
    for rays, widened, expected in ((100_000, 1.0, 21), (10_000, 1.0, 6), (10_000, 2.0, 3)):
        imager = spot_imager(
            measured, 622.5, {"rays": rays, "subpixels": "auto", "reach": 1.25}, widened=widened
        )
        # √(rays/1.5625/100)/1.2: 21.1, 6.7 and 3.3.
        assert imager.subpixels == expected
    assert spot_imager(measured, 622.5, {"subpixels": "auto"}, {"subpixels": 3}).subpixels == 3
    assert spot_imager(measured, 622.5, {"rays": 10, "subpixels": "auto"}).subpixels == 1
    # An image of four pixels has patches a fifth as wide: √(10 000/1.5625/4)/1.2 = 33.3.
    small = torch.zeros_like(image)
    small[0, 10:12, 10:12] = 7.0
    images = torch.cat([image, small])
    both = Measurement(images, torch.ones_like(images, dtype=torch.bool), 0.0, measured.sensor)
    imager = spot_imager(both, 622.5, {"rays": 10_000, "subpixels": "auto", "reach": 1.25})
    assert [imager.for_image(number).subpixels for number in (0, 1)] == [6, 33]
    # Of values alone, where 16 000 rays reach each pixel, they are eight times as narrow.
    settings = {"rays": 100_000, "subpixels": "auto", "reach": 1.25}
    for by, narrow in ((spot_imager, 105), (values_imager, 843)):
        assert by(both, 622.5, settings).for_image(0).subpixels == 21
        assert by(both, 622.5, settings).for_image(1).subpixels == narrow
    # 64 and 640 rays a pixel: √((450/64 - 1)/4π) pixels, and none.
    for rays, expected in ((10_000, 0.6928), (100_000, 0.0)):
        imager = spot_imager(measured, 622.5, {"rays": rays, "reach": 1.25})
        assert blur_for(measured, imager) == pytest.approx(expected, abs=1e-4)
