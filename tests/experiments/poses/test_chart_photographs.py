"""A camera's prescription from photographs of a chart, as a run: tables, metrics, files."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import dolens
from dolens.alignment.chart import Chart
from dolens.alignment.chart_fit import fit_chart
from dolens.alignment.chart_photons import ChartLight, TrueCamera, photographed
from dolens.alignment.spot_moments import one_thread
from dolens.experiments.poses.chart_simulation import drawn, simulated
from dolens.optics.elements import Element
from dolens.sensor.pixels import Sensor
from tests.experiments.tiny_experiment import QUIET

PITCH = 0.0069
SMALL = [
    "experiment=chart_photographs",
    "chart.rows=2",
    "planes=[2.4,2.8]",
    "pixel_pitch=0.0069",
    "module.pupil.rings=4",
    "module.pupil.arms=12",
    QUIET,
    "~lens.elements.front",
    "~lens.elements.rear",
]
SIMULATED = [
    *SMALL,
    "chart.columns=3",
    "chart.pitch=150",
    "photons=10000",
    "cameras=2",
    "subsets=[1]",
    "restoration.specimens=1",
    "restoration.fields=[[0,0],[9,6]]",
    "restoration.photons=20000",
    "restoration.size=33",
    "restoration.crop=96",
]


def test_a_camera_far_out_of_focus_is_found(made):
    """The 28th camera of seed 0: from weights of where its centroids put it, sums of the first pass
    lead ten deviations of the prior away, where rays miss the lens.
    """
    corners = ["chart.rows=2", "chart.columns=3", "chart.pitch=190", "subsets=[1]"]
    fine = ["pixel_pitch=0.0069", "module.pupil.rings=6", "module.pupil.arms=16", "photons=20000"]
    planes = "planes=[2.3,2.6,2.9]"
    module = made("experiment=chart_photographs", planes, "seed=0", *corners, *fine)
    model, prior = module.model, module.prior
    others = module.tolerances, module.unmodelled, module.seed
    specimen = drawn(module.lens, model, prior, *others, 28)
    seen = simulated(model, prior, specimen, module.light, module.windows.search_radius)
    coarse = replace(model, rays=replace(model.rays, rings=4, arms=12))
    with one_thread():
        fit = fit_chart([coarse, model], seen, prior)
    assert fit.converged
    # χ² is known to √(2·209) = 20; and the largest of thirty errors is below four.
    assert fit.chi_squared == pytest.approx(fit.degrees_of_freedom, abs=4 * 20)
    errors = (fit.numbers - specimen.truth) / fit.standard_errors
    assert float(errors.abs().max()) < 4.0


def test_drawn_cameras_are_fitted_and_their_scenes_restored(trained):
    ended = trained(*SIMULATED)
    metrics = ended.metrics
    assert metrics["fit/cameras"] == 2.0
    assert 0.6 < metrics["fit/chi_squared_per_freedom"] < 1.6
    assert metrics["coverage/all/within_2"] > 0.8
    assert metrics["gain/share"] > 0.5
    rows = ended.table("prescription")
    # 4 poses, 2 gaps, the sensor's distance; 4 of its pose, 6 of the chart, size, blur, 2 planes.
    assert len(rows) == 21
    for row in rows:
        name, found = row["parameter"], float(row["found"])
        share = float(row["error_over_prior"])
        assert float(row["low_95"]) < found < float(row["high_95"])
        assert 0.0 < share <= 1.0 + 1e-6
        assert metrics[f"error_over_prior/{name}/2_photographs"] == pytest.approx(share, rel=1e-6)
        assert name.startswith("planes.2") or f"error_over_prior/{name}/1_photographs" in metrics
    assert len(ended.table("cameras")) == 2 * 21
    assert len(ended.table("restored")) == 2
    combinations = ended.table("combinations")
    # A sensor farther away is no other than planes that are.
    assert float(combinations[0]["error_over_prior"]) == pytest.approx(1.0, abs=1e-3)
    assert ended.figures == {"marks", "intervals", "coverage", "restoration"}
    final = ended.lens()
    found = {row["parameter"]: float(row["found"]) for row in rows}
    assert float(final.thicknesses["2"]) == pytest.approx(found["thicknesses.2"], abs=1e-6)
    tilt = float(final.elements["middle"].tilt_x.detach())
    assert math.degrees(tilt) == pytest.approx(found["elements.middle.tilt_x"], abs=1e-6)


def test_photographs_in_files_give_the_prescription(trained, tmp_path):
    """Files of 16 bits, upright as a viewer shows them, of a lens whose gap is 30 µm too wide."""
    chart = Chart(1000.0, 2, 2, 60.0, 0.2)
    lens = dolens.load_lens("conf/lens/cooke_triplet.yaml", dtype=torch.float64)
    lens.elements["middle"] = Element(3, 4)
    lens.requires_grad_(False)
    lens.thicknesses["2"].add_(0.03)
    lens.elements["middle"].tilt_x.fill_(math.radians(0.1))
    camera = TrueCamera(lens, (0.0,) * 4, (1.0, -0.5, 0.0, 0.0, 0.0, 0.0), 0.0, 2e-6, (2.4, 2.8))
    sensor = Sensor(720, 760, PITCH)
    entries = []
    for number, plane in enumerate(camera.planes):
        # One window that is the sensor: columns of the file run along -x.
        extent = (sensor.width - 1) * PITCH, (sensor.height - 1) * PITCH
        corner = torch.tensor([-0.5 * extent[0], -0.5 * extent[1]], dtype=torch.float64)
        side = sensor.width
        one = TrueCamera(*list(vars(camera).values())[:5], (plane,))
        counts = photographed(
            chart,
            one,
            ChartLight(2e4, 2.0, 2.0, (587.5618,)),
            corner.expand(1, chart.count, 2),
            side,
            PITCH,
            torch.Generator().manual_seed(number),
        ).counts[0]
        # Backgrounds of the four windows are summed: 8 electrons, and read noise of 4.
        whole = counts.sum(0)[: sensor.height].flip(-1)
        path = tmp_path / f"{number}.png"
        Image.fromarray((whole + 100.0).clamp(min=0.0).round().numpy().astype(np.uint16)).save(path)
        entries.append(f"{{path: {path}, pixel_pitch: {PITCH}, dark_level: 100, read_noise: 4.0}}")
    given = f"photographs=[{','.join(entries)}]"
    ended = trained(*SMALL, "chart.columns=2", "chart.pitch=60", "subsets=[]", given)
    metrics = ended.metrics
    assert 0.5 < metrics["fit/chi_squared_per_freedom"] < 1.6
    assert not [name for name in metrics if name.startswith("coverage")]
    rows = {row["parameter"]: row for row in ended.table("prescription")}
    for name, true in (
        ("thicknesses.2", float(lens.thicknesses["2"])),
        ("elements.middle.tilt_x", 0.1),
        ("chart.x", 1.0),
        ("chart.y", -0.5),
    ):
        row = rows[name]
        assert "true" not in row
        error = float(row["standard_error"])
        assert abs(float(row["found"]) - true) < 4.0 * error, name
        assert error < 0.7 * float(row["prior_deviation"]), name
    assert ended.figures == {"marks", "intervals"}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("photographs=[{path: a.png, pixel_pitch: 0.0069}]", "photographs: 1 are given"),
        ("chart.shape=star", "chart.shape"),
        ("chart.size=200", "chart.size: 200"),
        ("camera.blur=0", "camera.blur: 0"),
        ("unmodelled.mark_size=2", "unmodelled.mark_size: 2"),
        ("restoration.size=64", "restoration.size: 64"),
        ("subsets=[5]", "subsets: 5; allowed: from 1 to 2"),
        ("photons=0", "photons: 0"),
        ("search_radius=0", "search_radius: 0"),
    ],
)
def test_what_is_wrong_is_named(override, message, refused):
    refused(message, *SIMULATED, override)
