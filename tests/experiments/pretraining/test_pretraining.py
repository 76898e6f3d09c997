"""Examples for a restorer of any lens are images as sensors give them, and follow from a number."""

import csv
import hashlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.experiments.pretraining import pretraining
from dolens.experiments.pretraining.pretraining import Draws, Examples, dead_leaves, text
from dolens.reconstruction.general import Stabiliser
from dolens.sensor.colour import srgb_to_linear
from tests.experiments.runs import same_to_the_bit
from tests.experiments.tiny_experiment import ONE_EPOCH, TINY, UNPICTURED, UNTESTED

# Bright, quiet, with all colours in each pixel, and of one depth that is told.
CLEAR = Draws(
    cameras=2, crops=1, side=32, light=(1e7, 1e7), read_noise=0.0, own_depth=1.0, bayer=0.0
)


def photographs():
    generator = np.random.default_rng(0)
    return [dead_leaves(generator, 96), text(generator, 128)]


def functions(shifts=(0, 0, 0)):
    """Points at one place for each depth, of all colours, (1, 3, 3, 9, 9)."""
    found = torch.zeros(1, 3, 3, 9, 9)
    for depth, shift in enumerate(shifts):
        found[0, depth, :, 4, 4 + shift] = 1.0
    return found


def examples(draws=CLEAR, of=None, seed=0):
    return Examples(photographs(), [1.0, 1.0], functions() if of is None else of, draws, seed)


def raw_images(example):
    """The sensor's images in linear light, (B, 3, H, W)."""
    return Stabiliser(example.given.pedestal).inverse(example.given.images[:, :3])


def test_a_batch_follows_from_its_number_and_the_seed():
    first, again = examples(), examples()
    first[0]
    assert torch.equal(first[7].truth, again[7].truth)
    assert torch.equal(first[7].given.images, again[7].given.images)
    assert not torch.equal(first[7].truth, first[8].truth)
    assert not torch.equal(first[7].truth, examples(seed=1)[7].truth)


def test_a_sharp_lens_in_bright_light_shows_the_truth():
    example = examples()[0]
    assert example.truth.shape == (2, 3, 32, 32)
    error = raw_images(example) - srgb_to_linear(example.truth)
    assert float(error.abs().max()) < 3e-3


def test_the_image_is_that_of_the_depth_whose_function_is_told():
    # A point beside the centre moves the image, and the filter that knows it moves it back.
    example = examples(of=functions((3, 3, 3)))[1]
    raw, truth = raw_images(example), srgb_to_linear(example.truth)
    moved = [torch.roll(truth, shift, dim) for dim in (-1, -2) for shift in (3, -3)]
    inner = (..., slice(4, -4), slice(4, -4))
    for number in range(2):
        errors = [float((raw[number] - m[number])[inner].abs().mean()) for m in moved]
        assert min(errors) < 1e-3
        assert float((raw - truth)[number][inner].abs().mean()) > 5e-3
    weak = Stabiliser(example.given.pedestal).inverse(example.given.images[:, 3:6])
    assert float((weak - truth)[inner].abs().mean()) < 2e-3


def test_the_noise_is_that_of_the_light():
    draws = replace(CLEAR, light=(100.0, 100.0), cameras=8)
    example = examples(draws)[0]
    truth = srgb_to_linear(example.truth)
    error = raw_images(example) - truth
    # The transform cannot hold what is below zero by more than its pedestal.
    bright = truth > 0.15
    found = (error[bright].square() / (truth[bright] / 100.0)).mean()
    assert float(found) == pytest.approx(1.0, abs=0.05)


def test_cameras_are_told_one_depth_or_several():
    draws = replace(CLEAR, own_depth=0.5, wrong=0.0, cameras=40)
    several = examples(draws)[0].given.known[:, 2]
    assert 0.25 < float(several.mean()) < 0.75


def test_small_photographs_go_on_as_their_mirror_image():
    small = [torch.arange(20, dtype=torch.uint8).expand(3, 50, 20)]
    found = Examples(small, [1.0], functions(), CLEAR, 0).photographs[0]
    assert found.shape == (3, 50, 40)
    assert torch.equal(found[..., :20].flip(-1), found[..., 20:40])


@pytest.mark.parametrize("draw", [dead_leaves, text])
def test_drawn_pictures_have_edges_and_follow_from_the_generator(draw):
    picture = draw(np.random.default_rng(3), 96)
    assert picture.shape == (3, 96, 96)
    assert torch.equal(picture, draw(np.random.default_rng(3), 96))
    steps = picture.float().diff(dim=-1).abs()
    assert float(steps.max()) > 60.0
    assert float(steps.median()) < 3.0


def listed(folder, columns, rows):
    """A list of photographs, and the photographs."""
    folder.mkdir(exist_ok=True)
    file = folder / f"list_{columns[0]}.csv"
    with file.open("w", newline="", encoding="utf-8") as target:
        csv.writer(target).writerows([columns, *rows])
    return file


def picture(folder, name, seed):
    """The hash of a drawn picture that is written there."""
    pixels = dead_leaves(np.random.default_rng(seed), 96).permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(folder / name)
    return hashlib.sha256((folder / name).read_bytes()).hexdigest()


def settings(folder):
    """An experiment that ends in seconds, with photographs of its own."""
    folder.mkdir(exist_ok=True)
    splits = ("train", "validation", "test")
    hashes = [picture(folder, f"{split}.png", n) for n, split in enumerate(splits)]
    rows = [[s, "own", "1", f"{s}.png", h, s] for s, h in zip(splits, hashes, strict=True)]
    columns = ["split", "package", "version", "path", "sha256", "title"]
    more = ["package", "version", "path", "member", "offset", "length"]
    more += ["sha256", "licence", "shrink", "weight"]
    further = ["own", "1", "more.png", "", "", "", picture(folder, "more.png", 9), "MIT", 1, 0.5]
    return [
        "experiment=pretrain_restoration",
        *TINY,
        f"data.manifest={listed(folder, columns, rows)}",
        f"data.further={listed(folder, more, [further])}",
        f"data.folders=[{folder}]",
        "+data.scikit_image=[]",
        "data.lenses=2",
        "data.draws.cameras=1",
        "data.draws.crops=1",
        "data.draws.side=32",
        "data.num_workers=0",
        "trainer.check_val_every_n_epoch=1",
        "trainer.precision=32-true",
        "scheduler.T_max=100",  # of a run that ends sooner too
        "network.width=8",
        "network.down=[1]",
        "network.middle=1",
        "network.up=[1]",
    ]


def test_a_resumed_training_is_the_same_to_the_bit(trained, tmp_path, monkeypatch):
    # Of each kind one drawn picture, and small ones: a run draws them as it begins.
    monkeypatch.setattr(pretraining, "_DRAWN", ((dead_leaves, 1), (text, 1)))
    monkeypatch.setattr(pretraining, "_DRAWN_SIDE", 64)
    own = [*settings(tmp_path / "photographs"), UNPICTURED]
    whole = trained(*own, folder="whole")
    begun = trained(*own, *UNTESTED, ONE_EPOCH, folder="begun")
    again = trained(*own, f"ckpt_path={begun.last}")
    assert again.objective == whole.objective
    first, second = whole.checkpoint(), again.checkpoint()
    assert first["global_step"] == second["global_step"] == 4
    for name in ("state_dict", "current_model_state"):
        assert same_to_the_bit(first[name], second[name])
    assert whole.metrics["test/photographs"] == 1.0
    assert "test/tv_psnr_db/worst" in whole.metrics


@pytest.mark.parametrize(
    ("expected", "overrides"),
    [
        ("network: FeaturePyramidRestoration; allowed for", ["network=feature_pyramid"]),
        (
            "variables: allowed for pretraining: null",
            ["variables={sensor_distance: {scale: 0.2}}", "network.held=false"],
        ),
        ("data.lenses", ["data.lenses=0"]),
        ("network.weights", ["network.weights=nowhere.pt"]),
    ],
)
def test_wrong_settings_are_named(refused, expected, overrides):
    refused(expected, "experiment=pretrain_restoration", *overrides)
