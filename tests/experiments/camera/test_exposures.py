"""A lens in several states shares one exposure time: brackets, sweeps, and motion between them."""

from functools import partial

import pytest
import torch
from hydra.errors import InstantiationException

from dolens.errors import InputError
from dolens.experiments.camera.network_export import exportable
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.commands.apply import apply_run
from dolens.experiments.commands.apply_options import Options
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.display import write_picture
from tests.experiments.conftest import finished_run
from tests.experiments.tiny_experiment import ONE_EPOCH, TINY, UNPICTURED
from tests.reconstruction.test_readouts import textured

SIDE, SIZE = 32, 33
BRACKET = (
    "experiment=focus_bracket",
    *(o for o in TINY if not o.startswith(("renderer", "views.psf"))),
    f"psf_size={SIZE}",
    "views.psf_pupil_samples=8",
    f"renderer.sensor.height={SIDE}",
    f"renderer.sensor.width={SIDE}",
    "renderer.pupil_samples=8",
    "renderer.jitter=false",
    "renderer.diffraction=none",
    "views.psf_diffraction=none",
    "evaluation_renderer=psf",
    "evaluation_renderer.pupil_samples=8",
    "evaluation_renderer.fields=[1,1]",
    "+evaluation_renderer.registration=centred",
    "+evaluation_renderer.illumination=functions",
)
NOISELESS = ("readout=ideal",)
STILL = ("exposures.motion=0.0",)


@pytest.fixture
def camera(made):
    return partial(made, *BRACKET, "lens_dtype=float64")


def texture(count=1, seed=0):
    """Smooth light, which shifts by fractions of a pixel move as they say."""
    side = SIDE + 2 * (SIZE // 2)
    generator = torch.Generator().manual_seed(seed)
    spectrum = torch.fft.rfft2(torch.randn(count, 3, side, side, generator=generator))
    down, right = torch.fft.fftfreq(side)[:, None], torch.fft.rfftfreq(side)
    smooth = spectrum * (-60.0 * (down**2 + right**2)).exp()
    values = torch.fft.irfft2(smooth, s=(side, side))
    return (0.5 + 0.15 * values / values.std()).clamp(0.0, 1.0).double()


def taken(module, textures, stage="test"):
    with torch.no_grad():
        return module.take(module.variables(), Shot(textures, stage, 0))


def test_each_readout_is_the_image_of_the_lens_in_its_state(camera):
    module = camera(*NOISELESS, *STILL, "light=null")
    found, _ = taken(module, texture())
    assert found.readouts.shape == (1, 3, 3, 3, SIDE, SIDE)
    for number, distance in enumerate((95.5, 95.86, 96.25)):
        alone = camera(
            "exposures=null",
            "variables=null",
            "network.held=false",
            "light=null",
            *NOISELESS,
            f"lens.sensor.distance={distance}",
        )
        one, _ = taken(alone, texture())
        torch.testing.assert_close(found.readouts[:, :, number], one.raw)
        torch.testing.assert_close(found.truth, one.truth)
    # The sharpest plane of each state is another one.
    contrast = found.readouts.var(dim=(-2, -1)).mean(dim=-1)[0]
    assert contrast.argmax(dim=1).tolist() == [0, 1, 2]


def test_readouts_share_the_light_and_pay_read_noise_each(camera):
    module = camera(*STILL, "exposures.shares=[0.5,0.3,0.2]", "light=100", "read_noise=0.002")
    white = torch.full((4, 3, SIDE + 32, SIDE + 32), 0.5, dtype=torch.float64)
    found, _ = taken(module, white)
    read = 0.002 * 8180.0  # electrons
    for number, share in enumerate((0.5, 0.3, 0.2)):
        electrons = 100.0 * share
        told = module.views.noise[number]
        # The lens's F-number is 8.03 to a thousandth.
        assert told == pytest.approx((1.0 / electrons, (read / electrons) ** 2), rel=5e-3)
        light = found.readouts[:, 1, number].mean()
        seen = float(found.readouts[:, 1, number].var())
        assert float(light) == pytest.approx(0.5, abs=0.02)
        assert seen == pytest.approx(told[0] * 0.5 + told[1], rel=0.05)
    # What the sensor gives for a picture is all the light.
    mean = float(found.raw[:, 1].var())
    assert mean == pytest.approx(0.5 / 100.0 + 3.0 * (read / 100.0) ** 2, rel=0.05)


def test_a_sweep_is_read_out_once_and_blurs_by_the_mean_of_its_functions(camera):
    module = camera("exposures.readouts=one", *STILL, "exposures.motion_is=known", *NOISELESS)
    bracket = camera(*STILL, *NOISELESS)
    values = module.variables()
    each = bracket.views.point_spread_functions(bracket.lens.with_values(values))
    one = module.views.point_spread_functions(module.lens.with_values(values))
    torch.testing.assert_close(one, each.mean(dim=0))
    swept, _ = taken(module, texture())
    apart, _ = taken(bracket, texture())
    assert swept.readouts is None
    torch.testing.assert_close(swept.raw, apart.readouts.mean(dim=2))


def test_known_motion_is_in_the_functions_that_restorers_are_told(camera):
    """Readouts are the truth behind them; the middle one, of which the truth is, rests."""
    module = camera(*NOISELESS, "exposures.motion=1.5", "exposures.motion_is=known")
    found, functions = taken(module, texture())
    still = module.views.point_spread_functions(module.lens.with_values(module.variables()))
    steps = found.motion.norm(dim=1)
    torch.testing.assert_close(steps, torch.tensor([1.5, 0.0, 1.5]).to(steps))
    torch.testing.assert_close(found.motion[0], -found.motion[2])

    def error(told, state, depth):
        kernel = told[state, depth].flip((-2, -1))[:, None].double()
        seen = torch.nn.functional.conv2d(texture(), kernel, groups=3)[0]
        return float((seen - found.readouts[0, depth, state]).abs()[:, 4:-4, 4:-4].max())

    for state, depth in ((0, 0), (0, 2), (2, 0), (2, 2)):
        assert error(functions, state, depth) < 0.008 < 0.025 < error(still, state, depth)


def test_motion_is_estimated_of_each_image_by_itself(camera):
    side = ("renderer.sensor.height=96", "renderer.sensor.width=96", "exposures.motion=1.0")
    module = camera(*side, "light=3000")
    scene = torch.stack([textured(128, 3), textured(128, 4)]).double()
    found, functions = taken(module, scene)
    assert functions.shape == (6, 3, 3, 3, SIZE, SIZE)
    still = module.views.point_spread_functions(module.lens.with_values(module.variables()))
    moved = (centres(functions) - centres(still))[:, :, 1, 1]  # of each image and readout
    assert float((moved - found.motion.to(moved)).abs().max()) < 0.3
    ignored = camera(*side, "exposures.motion_is=ignored")
    _, told = taken(ignored, scene)
    torch.testing.assert_close(told, still)


def centres(functions):
    """Centroids of point spread functions (..., K, K), pixels down and to the right."""
    offset = torch.arange(functions.shape[-1]).to(functions) - functions.shape[-1] // 2
    mass = functions.sum(dim=(-2, -1))
    down = (functions.sum(dim=-1) * offset).sum(dim=-1) / mass
    right = (functions.sum(dim=-2) * offset).sum(dim=-1) / mass
    return torch.stack([down, right], dim=-1)


def test_foci_have_the_gradient_of_the_loss(camera):
    """By differences, through images and functions of all states."""
    module = camera(*NOISELESS, *STILL, "network.by_depth=false")
    module.network.double()
    batch, scaled = texture(), module.variables.scaled

    def value():
        found, functions = module.take(module.variables(), Shot(batch, "train", 0))
        return (module.restore(found, functions) - found.truth).square().mean()

    (slope,) = torch.autograd.grad(value(), scaled)
    step = 1e-3
    for number in range(3):
        ends = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                scaled[number] += sign * step
                ends.append(float(value()))
                scaled[number] -= sign * step
        assert float(slope[number]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=2e-3)


def test_noise_of_readouts_is_drawn_apart(camera):
    module = camera(*STILL)
    found, _ = taken(module, texture())
    clean, _ = taken(camera(*STILL, *NOISELESS), texture())
    noise = (found.readouts - clean.readouts)[0].flatten(2)
    far, near = noise[0, 0], noise[0, 2]
    correlation = (far * near).mean() / (far.square().mean() * near.square().mean()).sqrt()
    assert abs(float(correlation)) < 0.06


def test_a_bracket_trains_and_is_judged_beside_untrained_restorers(trained):
    short = ("data.batch_size=1", ONE_EPOCH, "trainer.check_val_every_n_epoch=1")
    found = trained(*BRACKET, "light=1000", *short)
    metrics = found.metrics
    assert metrics["test/psnr_db/worst"] > metrics["test/raw_psnr_db/worst"]
    assert "test/tv_psnr_db/worst" in metrics
    gain = metrics["test/gain_over_plain_db"]
    assert gain == pytest.approx(metrics["test/psnr_db"] - metrics["test/plain_psnr_db"], abs=1e-3)
    foci = [metrics[f"variables/states.{name}.sensor_distance"] for name in ("far", "near")]
    assert foci != [95.5, 96.25]
    assert {"images", "point_spread_functions", "layout"} <= found.figures


def test_a_bracket_is_applied_to_whole_pictures_at_rest(root, tmp_path):
    """Its sensor's picture is the mean of the readouts, and what is restored is of all of them."""
    untrained = ("network=wiener_tv", "train=false", "light=1000", UNPICTURED)
    folder = finished_run(root, tmp_path, *BRACKET, *untrained)
    picture = tmp_path / "scene.png"
    write_picture(picture, linear_to_srgb(texture()[0].float().repeat(1, 2, 2)), 16)
    _, _, (made,) = apply_run(folder, [picture], Options())
    assert made.metrics["psnr_db"] > made.metrics["raw_psnr_db"]
    with pytest.raises(InputError, match="--raw: a camera of several readouts"):
        apply_run(folder, [picture], Options(raw=True))


def test_the_plain_lens_beside_has_all_the_light_that_its_stop_passes(camera):
    module = camera("light=1000")
    arguments = (module.lens.with_values(module.variables()), Shot(texture(), "test", 0))
    with torch.no_grad():
        found = module.views.plain_exposure(*arguments)
    # At F/16 a quarter of F/8's, and all the time: 4/3 of the share's noise of a third.
    shot, read = module.views.noise[0]
    assert found.noise == pytest.approx((4.0 * shot / 3.0, 16.0 * read / 9.0), rel=0.02)
    alone = camera(
        "exposures=null",
        "variables=null",
        "network.held=false",
        "light=1000",
        "lens.sensor.distance=95.82",
        "lens.surfaces.1.semi_diameter=3.175",
    )
    one, _ = taken(alone, texture())
    torch.testing.assert_close(found.taken.raw, one.raw)
    assert list(module.views.shares) == ["far", "middle", "near"]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("~lens.states.far", "~lens.states.near"), "exposures: .*has 1 states; needed: two"),
        (("exposures.shares=[0.5,0.5]",), "exposures.shares: 2 of 3 states"),
        (("exposures.shares=[0.5,0.5,0.5]",), "exposures.shares: their sum is 1.5"),
        (("exposures.beside=side",), "has no state 'side'"),
        (("exposures.motion=9",), "exposures.motion: 9"),
        (("exposures.motion_is=guessed",), "exposures.motion_is"),
        (("exposures.readouts=one",), "exposures.motion_is: estimated; allowed with one readout"),
        (("network=unet",), "exposures: UNetRestoration takes one readout"),
        (("optimizer.lens=dls",), "optimizer.lens: dls; allowed with exposures: adam"),
        (("tolerances={sensor_distance: 0.1}",), "exposures: given; allowed with tolerances: null"),
    ],
)
def test_what_exposures_cannot_be_is_refused_in_one_line(camera, overrides, message):
    with pytest.raises((InputError, InstantiationException), match=message):
        camera(*overrides)


def test_a_network_of_several_readouts_is_not_exported(camera):
    with pytest.raises(InputError, match=r"exposures.readouts: each; allowed in an exported"):
        exportable(camera())


def test_a_camera_of_a_field_tells_each_readout_s_function_of_each_place(made):
    """With operands of the lens, which are of none of its states."""
    module = made(
        "experiment=form_camera",
        "optimizer.lens=adam",
        "renderer.sensor.height=32",
        "renderer.sensor.width=32",
        "psf_size=17",
        "+lens.states={far: {sensor: {distance: 42.21}}, near: {sensor: {distance: 42.6}}}",
        "++exposures={_target_: dolens.experiments.camera.views.exposures.Exposures}",
        "~variables",
        "++variables={states.*.sensor_distance: {scale: 0.05}}",
    )
    textures = torch.rand(2, 3, 48, 48, generator=torch.Generator().manual_seed(0))
    found, functions = module.take(module.variables(), Shot(textures, "train", 0))
    views = found.raw.shape[1]
    assert found.readouts.shape == (2, views, 2, 3, 32, 32)
    assert functions.shape[:3] == (2 * views, 2, 1)
    # Out of focus, the near state blurs more at each place.
    peaks = functions.amax(dim=(-2, -1)).mean(dim=-1)[:, :, 0]
    assert bool((peaks[:, 0] > 1.5 * peaks[:, 1]).all())
    total, _ = module.lens_steps.penalty(module.variables())
    loss = (module.restore(found, functions) - found.truth).square().mean() + total
    (slope,) = torch.autograd.grad(loss, module.variables.scaled)
    assert bool((slope != 0.0).all())
