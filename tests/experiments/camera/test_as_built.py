"""Cameras are trained and judged through lenses as they are built."""

from functools import partial

import pytest
import torch

from dolens import InputError
from dolens.experiments.camera.as_built import AsBuilt, Manufacture
from dolens.experiments.camera.made_lenses import (
    MadeLensScores,
    images_of_made_lenses,
    spread_over_photographs,
)
from dolens.experiments.camera.views.base import Shot
from dolens.rendering.psf import axial_point_spread_functions
from tests.experiments.tiny_experiment import CAMERA, ONE_EPOCH

AS_BUILT = [
    "experiment=wavefront_coding_as_built",
    *(o for o in CAMERA[1:] if not o.startswith("renderer=")),
    ONE_EPOCH,
    "as_built.tested=5",
]

# Windows of the textures' size.
WINDOWS = {
    "phone_camera": (),
    "large_fov_doublet": ("renderer.sensor.height=64", "renderer.sensor.width=64"),
}


@pytest.fixture
def camera(made):
    return partial(made, *AS_BUILT, "lens_dtype=float64")


def textures(count=2, side=24 + 32):
    return torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(5))


def test_a_run_is_judged_by_the_lenses_of_its_table(trained):
    found = trained(*AS_BUILT, "as_built.judged_factors=[3]")
    metrics, rows, crops = found.metrics, found.table("made_lenses"), found.table("made_crops")
    worst = sorted(float(row["psnr_db/worst"]) for row in rows)
    assert len(rows) == metrics["made/lenses"] == 5
    # The worst tenth of five lenses is one of them.
    assert metrics["made/psnr_db/worst_decile"] == pytest.approx(worst[0], rel=1e-6)
    assert metrics["made/psnr_db/mean"] == pytest.approx(sum(worst) / 5, rel=1e-6)
    passing = metrics["made/psnr_db/as_drawn"] - 1.0
    assert metrics["made/yield"] == sum(score >= passing for score in worst) / 5
    low, high = (metrics[f"error/made/psnr_db/worst_decile/{end}"] for end in ("low", "high"))
    assert low <= metrics["made/psnr_db/worst_decile"] <= high
    assert max(abs(float(row["elements.plate.tilt_x (deg)"])) for row in rows) <= 0.2
    assert max(abs(float(row["surfaces.2.curvature (%)"])) for row in rows) <= 1.0
    assert "made_lenses" in found.figures
    assert metrics["train/loss"] > 0.0
    views = [name for name in crops[0] if name.startswith("psnr_db/")]
    for factor, column in (("1", "made"), ("3", "made/factor_3")):
        of = [r for r in crops if r["factor"] == factor]
        means = []
        for lens in map(str, range(5)):
            table = [[float(r[view]) for view in views] for r in of if r["lens"] == lens]
            means.append(min(sum(c) / len(c) for c in zip(*table, strict=True)))
        assert metrics[f"{column}/psnr_db/worst_decile"] == pytest.approx(min(means), rel=1e-6)
    # The same camera, whatever it is judged by.
    drawn = "psnr_db/as_drawn"
    assert metrics[f"made/{drawn}"] == metrics[f"made/factor_3/{drawn}"]


def test_crops_are_of_as_many_photographs_as_there_are():
    photographs = ["cat", "cat", "cat", "rocket", "coffee", "coffee"]
    assert spread_over_photographs(photographs, 4) == [0, 1, 3, 4]
    assert spread_over_photographs(photographs, 9) == [0, 1, 2, 3, 4, 5]


def test_lenses_without_errors_image_as_the_lens_that_is_drawn(camera):
    module = camera("as_built.factor=1e-9", "as_built.lenses_per_step=2")
    design, batch = module.variables(), textures()
    drawn, functions = module.take(design, Shot(batch, "train", 0))
    made = module.manufacture.for_step(module.lens.with_values(design), 0)
    assert len(made) == 2
    taken, own = images_of_made_lenses(module, module.manufacture, made, design, batch, None)
    # The sensor's noise too is that of the whole batch.
    torch.testing.assert_close(taken.raw, drawn.raw, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(taken.truth, drawn.truth, rtol=0.0, atol=1e-4)
    for part in own:
        torch.testing.assert_close(part, functions, rtol=0.0, atol=1e-6)


def test_errors_at_another_factor_are_in_proportion(camera):
    module = camera("as_built.factor=2")
    design = module.variables()
    wide = module.manufacture.at_factor(6.0)
    one, other = (
        m.tested(module.lens.with_values(design), 3).errors for m in (module.manufacture, wide)
    )
    torch.testing.assert_close(other, 3.0 * one)


def test_each_lens_has_its_part_of_the_batch(camera):
    module = camera("as_built.lenses_per_step=2", "as_built.calibration=own")
    design, batch = module.variables(), textures()
    made = module.manufacture.for_step(module.lens.with_values(design), 3)
    taken, own = images_of_made_lenses(module, module.manufacture, made, design, batch, None)
    for number, lens in enumerate(made):
        functions = module.views.point_spread_functions(module.lens.with_values(lens.values))
        torch.testing.assert_close(own[number], functions)
    assert (own[0] - own[1]).abs().max() > 1e-4
    assert taken.raw.shape[0] == 2


def test_judging_lenses_are_those_of_every_seed_and_no_training_s(camera):
    one, other = camera(), camera("seed=7")
    first, again = (
        m.manufacture.tested(m.lens.with_values(m.variables()), 4) for m in (one, other)
    )
    assert torch.equal(first.errors, again.errors)
    trained = [
        m.manufacture.for_step(m.lens.with_values(m.variables()), 4)[0] for m in (one, other)
    ]
    assert not torch.equal(trained[0].errors, trained[1].errors)
    assert not torch.equal(first.errors, trained[0].errors)


def test_the_image_of_a_made_lens_is_differentiable_in_the_design(camera):
    module = camera("renderer.jitter=false", "renderer.pupil_samples=48", "readout=ideal")
    # All but the stop: a disc that it cuts elsewhere is seen to move evenly by many samples only.
    given = {
        "elements.plate.tilt_[xy]": 0.3,
        "elements.plate.decenter_[xy]": 0.2,
        "surfaces.[123].curvature": {"half_range": 0.01, "relative": True},
        "thicknesses.[1234]": 0.1,
        "media.[124].index_offset": 5e-4,
        "surfaces.*.astigmatism_*": 2e-4,
    }
    settings = AsBuilt(calibration="own")
    batch = textures(1).double()
    weight = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(1)).double()
    manufacture = Manufacture(settings, given, module.lens, module.views)
    scaled = module.variables.scaled

    def loss(at):
        scaled.data.copy_(at)
        values = module.variables()
        made = manufacture.for_step(module.lens.with_values(values), 2)
        taken, own = images_of_made_lenses(module, manufacture, made, values, batch, None)
        return (taken.raw.double() * weight).sum() + 100.0 * own[0].double().square().sum()

    start, step = scaled.detach().clone(), 0.01
    (gradient,) = torch.autograd.grad(loss(start), scaled)
    with torch.no_grad():
        differences = torch.stack(
            [
                (loss(start + shift) - loss(start - shift)) / (2 * step)
                for shift in step * torch.eye(len(start), dtype=start.dtype)
            ]
        )
    assert (gradient - differences).norm() < 0.01 * gradient.norm()


def test_measured_functions_keep_their_light_and_the_derivative_of_the_exact_ones(camera):
    module = camera("as_built.calibration=measured", "as_built.electrons=1000")
    design = module.variables()
    made = module.manufacture.tested(module.lens.with_values(design), 0)

    def told(values):
        return module.views.point_spread_functions(module.lens.with_values(values))

    measured = module.manufacture.functions(told, design, made)
    exact = module.views.point_spread_functions(module.lens.with_values(made.values))
    assert (measured - exact).abs().max() > 1e-3
    torch.testing.assert_close(measured.sum((-2, -1)), exact.sum((-2, -1)), rtol=1e-5, atol=1e-6)
    weight = torch.rand(exact.shape[-2:], generator=torch.Generator().manual_seed(0)).to(exact)
    slopes = [
        torch.autograd.grad((found * weight).sum(), module.variables.scaled, retain_graph=True)[0]
        for found in (measured, exact)
    ]
    torch.testing.assert_close(*slopes)
    again = module.manufacture.functions(told, design, made)
    assert torch.equal(measured, again)


def test_the_image_of_a_shifted_lens_is_registered_by_its_chief_ray(camera):
    module = camera()
    values = {
        "elements.doublet.decenter_x": torch.tensor(0.05, dtype=torch.float64),
        "surfaces.5.x3": torch.zeros((), dtype=torch.float64),
        "surfaces.5.y3": torch.zeros((), dtype=torch.float64),
    }
    views, lens = module.views, module.lens
    centred = views.point_spread_functions(lens.with_values(values), size=65)
    apart = axial_point_spread_functions(lens.with_values(values), views.scene, views.sensor, 65, 8)
    column = torch.arange(65, dtype=centred.dtype) - 32

    def mean(functions):
        return (functions.sum(-2) * column).sum(-1) / functions.sum((-2, -1))

    # A lens that is 0.05 mm aside moves the image by as much, seven pixels of 6.9 µm.
    moved = (mean(apart) - mean(centred)).abs()
    torch.testing.assert_close(moved, torch.full_like(moved, 0.05 / 0.0069), rtol=0.05, atol=0.0)
    assert mean(centred).abs().max() < 0.5
    # A lens without errors has its chief ray on the axis.
    same = axial_point_spread_functions(lens, views.scene, views.sensor, 33, 8)
    assert torch.equal(views.point_spread_functions(lens), same)


def test_sensitivity_counts_in_the_loss_by_its_weight(camera):
    module = camera("as_built.desensitising=0.5")
    twice = camera("as_built.desensitising=1.0")
    small = camera("as_built.desensitising=1.0", "as_built.factor=0.1")
    found = [
        m.manufacture.penalty(m.lens.with_values(m.variables())) for m in (module, twice, small)
    ]
    torch.testing.assert_close(2.0 * found[0], found[1])
    torch.testing.assert_close(found[1], 100.0 * found[2], rtol=1e-6, atol=0.0)
    (slope,) = torch.autograd.grad(found[1], twice.variables.scaled)
    assert slope.abs().max() > 0.0
    assert float(camera().manufacture.penalty(module.lens.with_values(module.variables()))) == 0.0


def test_the_worst_decile_is_the_mean_of_the_worst_tenth(camera):
    module = camera()
    worst = torch.arange(1.0, 31.0, dtype=torch.float64)
    scores = MadeLensScores(
        ("a", "b"),
        torch.stack([worst, worst + 5.0], 1)[:, None].expand(-1, 3, -1),
        ("cat", "cat", "dog"),
        torch.tensor([20.0, 30.0]),
        torch.zeros(30, len(module.manufacture.tolerances.names)),
        module.manufacture.tolerances,
        2.0,
        0.1,
    )
    numbers = scores.numbers()
    assert numbers["made/psnr_db/worst_decile"] == 2.0
    assert numbers["made/yield"] == pytest.approx(13 / 30)
    assert numbers["made/psnr_db/as_drawn"] == 20.0


@pytest.mark.parametrize(
    ("words", "overrides"),
    [
        ("as_built.calibration", ["as_built.calibration=exact"]),
        ("as_built.lenses_per_step", ["as_built.lenses_per_step=0"]),
        ("as_built.electrons", ["as_built.electrons=-1"]),
        ("as_built.tested", ["as_built.tested=-1"]),
        ("as_built.judged_factors", ["as_built.judged_factors=[0]"]),
        ("surfaces.9.curvature", ["+tolerances={surfaces.9.curvature: 0.1}"]),
        # A renderer whose images stay where the design's are.
        ("moves its image", ["renderer=rays"]),
        # A weight that least squares would not see.
        ("as_built.desensitising", ["optimizer.lens=dls", "as_built.desensitising=0.1"]),
    ],
)
def test_what_is_wrong_is_said_before_a_step(refused, words, overrides):
    refused(words, *AS_BUILT, *overrides)


def test_a_renderer_that_chooses_may_not_leave_images_where_the_design_s_are(refused):
    others = (o for o in AS_BUILT if "renderer.pupil" not in o)
    refused("moves its image", *others, "renderer=auto")


def test_no_tolerances_are_not_the_lens_as_drawn(refused):
    refused("tolerances: none is given", *CAMERA, "tolerances={}")


def test_a_batch_that_lenses_cannot_share_equally_is_refused(camera):
    module = camera("as_built.lenses_per_step=2")
    design = module.variables()
    made = module.manufacture.for_step(module.lens.with_values(design), 0)
    with pytest.raises(InputError, match="lenses_per_step"):
        images_of_made_lenses(module, module.manufacture, made, design, textures(3), None)


@pytest.mark.parametrize(
    ("experiment", "glasses", "surfaces"),
    [("phone_camera", 5, 10), ("large_fov_doublet", 2, 3)],
)
def test_other_cameras_are_made_with_errors_of_index_and_shape(made, experiment, glasses, surfaces):
    module = made(f"experiment={experiment}_as_built", "network=unet", *WINDOWS[experiment])
    names = module.manufacture.tolerances.names
    assert sum(name.startswith("media.") for name in names) == glasses
    assert sum(".astigmatism_" in name for name in names) == 2 * surfaces
    design, batch = module.variables(), textures(1, 64 + 64)
    made = module.manufacture.for_step(module.lens.with_values(design), 0)
    taken, _ = images_of_made_lenses(module, module.manufacture, made, design, batch, None)
    drawn, _ = module.take(design, Shot(batch, "train", 0))
    difference = (taken.raw - drawn.raw).detach().abs().max()
    assert 1e-4 < difference < 1.0
    (slope,) = torch.autograd.grad(taken.raw.square().mean(), module.variables.scaled)
    assert bool(slope.isfinite().all()) and slope.abs().max() > 0.0
