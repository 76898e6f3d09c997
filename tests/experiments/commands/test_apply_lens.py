"""`dolens apply LENS`: any lens's image of a picture, and what is restored of it, untrained."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from dolens import load_lens, save_lens
from dolens.cli.app import app
from dolens.errors import InputError
from dolens.experiments.commands.apply_lens import AppliedLens
from dolens.experiments.commands.apply_options import LensOptions, depth_of, size_of
from dolens.reconstruction import psnr_db, restore
from dolens.rendering.photograph import read_out
from dolens.sensor.colour import linear_to_srgb, srgb_to_linear
from dolens.sensor.display import write_picture
from dolens.sensor.pictures import read_pixels
from dolens.sensor.readout import Readout


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A folder with a picture of blocks, and the triplet as a Zemax file."""
    folder = tmp_path_factory.mktemp("apply_lens")
    generator = torch.Generator().manual_seed(3)
    # Colours of photographs: mostly grey.
    grey = 0.2 + 0.6 * torch.rand(1, 1, 8, 12, generator=generator)
    coarse = grey + 0.2 * (torch.rand(1, 3, 8, 12, generator=generator) - 0.5)
    write_picture(folder / "blocks.png", torch.nn.functional.interpolate(coarse, (64, 96))[0], 8)
    save_lens(load_lens("cooke_triplet"), folder / "triplet.zmx")
    return folder


@pytest.fixture(autouse=True)
def at_work(work, monkeypatch):
    monkeypatch.chdir(work)
    monkeypatch.setenv("COLUMNS", "200")


def applied(*words):
    done = CliRunner().invoke(app, ["apply", *words])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.output


def encoded(path):
    return linear_to_srgb(read_pixels(path).linear())


def test_a_lens_file_images_a_picture_and_restores_it(work):
    said = applied("triplet.zmx", "blocks.png")
    folder = work / "triplet_applied"
    assert {p.name for p in folder.iterdir()} == {
        "blocks_sensor.png", "blocks_restored.png", "blocks_comparison.png", "blocks.json",
        "photographs.html",
    }  # fmt: skip
    record = json.loads((folder / "blocks.json").read_text())
    numbers = record["images"]["blocks"]
    # The picture lies on the triplet's image circle, and its corners are dimmer and blurred.
    assert "96×64 pixels of 314 µm, 30.2×20.1 mm" in numbers["mapping"] and "inf" in said
    assert numbers["mapping"] in said and numbers["depth_mm"] is None
    assert numbers["psnr_db"] > numbers["raw_psnr_db"] + 3.0
    truth, restored = encoded("blocks.png"), encoded(folder / "blocks_restored.png")
    assert restored.shape == truth.shape
    page = (folder / "photographs.html").read_text()
    assert f"<td>{numbers['psnr_db']:.2f}</td>" in page and "blocks at infinity" in page
    # The triplet's distortion is less than a pixel here.
    assert float(psnr_db(restored[None], truth[None])) > 15.0


def test_the_library_gives_the_same_numbers(work):
    words = ("--depth=2m", "--light=1000", "--bayer", "--save-raw", "--bits=16", "--out=same")
    applied("triplet.zmx", "blocks.png", *words)
    lens = load_lens("triplet.zmx")
    photograph = lens.photograph("blocks.png", distance=2000, light=1000, pattern="RGGB")
    assert np.array_equal(np.load(work / "same/blocks_raw.npy"), photograph.signal[0].numpy())
    for kind, picture in (("sensor", photograph), ("restored", restore(photograph))):
        picture.save(work / f"same/{kind}.png", 16)
        files = (work / f"same/blocks_{kind}.png", work / f"same/{kind}.png")
        assert files[0].read_bytes() == files[1].read_bytes()


def test_a_name_and_its_file_are_the_same_lens_and_noise_is_the_seed_s(work):
    for lens, seed in (("cooke_triplet", "1"), ("triplet.zmx", "1"), ("cooke_triplet", "2")):
        out = f"same_{lens.partition('.')[2]}{seed}"
        applied(lens, "blocks.png", "--seed", seed, "--out", out, "--bits", "16")
    name, file, other = (
        encoded(work / out / "blocks_restored.png") for out in ("same_1", "same_zmx1", "same_2")
    )
    assert (name - file).abs().max() < 1e-3
    assert (name - other).abs().max() > 1e-2


def test_a_bayer_sensor_has_one_colour_a_pixel_and_its_picture_three(work):
    words = ("--bayer", "--save-raw", "--light", "10000", "--out", "bayer")
    assert "filters RGGB" in applied("triplet.zmx", "blocks.png", *words)
    raw = np.load(work / "bayer/blocks_raw.npy")
    assert raw.shape == (64, 96)
    restored, truth = encoded(work / "bayer/blocks_restored.png"), encoded("blocks.png")
    # What blur is left keeps the mean of the light, and not that of its encoding.
    colours = [srgb_to_linear(image).flatten(1).mean(1) for image in (restored, truth)]
    assert torch.allclose(colours[0], colours[1], atol=0.02)
    assert float(psnr_db(restored[None], truth[None])) > 18.0


def test_more_light_restores_more(work):
    found = []
    for light in ("30", "10000"):
        applied("triplet.zmx", "blocks.png", "--light", light, "--out", f"light_{light}")
        record = json.loads((work / f"light_{light}/blocks.json").read_text())
        found.append(record["images"]["blocks"]["psnr_db"])
    assert found[1] > found[0] + 3.0


def test_of_several_depths_the_restorer_is_told_all(work):
    """A double Gauss lens focused on infinity sees what is near worse, whether it knows or not."""
    said = applied("double_gauss", "blocks.png", "--depth", "3m", "--depth", "inf", "--light=10000")
    record = json.loads((work / "double_gauss_applied/blocks.json").read_text())["images"]
    assert set(record) == {"blocks_3m", "blocks_infm"} and "3 │" in said
    assert record["blocks_3m"]["raw_psnr_db"] < record["blocks_infm"]["raw_psnr_db"]
    near, far = (
        np.asarray(Image.open(work / f"double_gauss_applied/blocks_{depth}_depth.png")).mean()
        for depth in ("3m", "infm")
    )
    assert near > 170.0 and far < 85.0  # white is near, black is far
    camera = AppliedLens(load_lens("double_gauss"), LensOptions(depths=(3000.0, float("inf"))))
    told = []
    camera.restorer = lambda raw, functions, field, noise: told.append(functions) or raw
    camera.apply(work / "blocks.png", work)
    assert {f.shape[0] for f in told} == {2}


def test_pixels_and_sensor_may_be_chosen():
    lens = load_lens("cooke_triplet")

    def sensor(**options):
        found = AppliedLens(lens, LensOptions(**options)).sensor(400, 600)
        return found.height, found.width, pytest.approx(found.pixel_pitch, rel=1e-3)

    assert sensor(sensor=(18.0, 12.0)) == (400, 600, 0.03)
    assert sensor(sensor=(18.0, 12.0), pitch=60.0) == (200, 300, 0.06)
    assert sensor(sensor=(18.0, 12.0), scale=4.0) == (100, 150, 0.12)
    with pytest.raises(InputError, match=r"pixel_pitch: .* megapixels; allowed: 64"):
        sensor(pitch=0.5)


def test_noise_does_not_depend_on_how_much_is_read_out_at_once():
    image = torch.rand(3, 600, 8)
    readout = Readout(full_well=100.0, read_noise=0.03, pattern="RGGB")
    signal = read_out(image.clone(), readout, 4)
    generator = torch.Generator().manual_seed(4)
    parts = [readout(part, generator) for part in image.split(256, dim=1)]
    assert torch.equal(signal, torch.cat(parts, dim=1))
    deviation = (signal - Readout(pattern="RGGB")(image, generator)).std()
    assert deviation == pytest.approx((0.5 / 100.0 + 0.0009) ** 0.5, rel=0.05)


def test_depths_and_sizes_are_read_as_they_are_written():
    lengths = {"4500": 4500.0, "6m": 6000.0, "30 cm": 300.0, "2.5km": 2.5e6, "1e3mm": 1000.0}
    assert {text: depth_of(text) for text in lengths} == lengths
    assert depth_of("inf") == depth_of("infinity") == float("inf")
    assert size_of("36x24") == size_of("36×24") == (36.0, 24.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nolens", "blocks.png"], "lens 'nolens': no such file"),
        (["nolens.zmx", "blocks.png"], "nolens.zmx"),
        (["triplet.zmx", "none.png"], "none.png"),
        (["triplet.zmx", "blocks.png", "--depth", "6 feet"], "--depth: '6 feet' is no length"),
        (["triplet.zmx", "blocks.png", "--depth", "1,5m"], "--depth: '1,5m' is no length"),
        (["triplet.zmx", "blocks.png", "--depth", "-2m"], "--depth: -2000; allowed: above 0"),
        (["triplet.zmx", "blocks.png", "--sensor", "36"], "--sensor: '36'; allowed: WIDTHxHEIGHT"),
        (["triplet.zmx", "blocks.png", "--sensor", "900x600"], "do not pass the lens"),
        (["triplet.zmx", "blocks.png", "--light", "0"], "light: 0.0; allowed: above 0"),
        (["triplet.zmx", "blocks.png", "--pitch=4", "--scale=2"], "--pitch and --scale both"),
        (["triplet.zmx", "blocks.png", "--scale", "9"], "16 or more along each side"),
        (["triplet.zmx", "blocks.png", "--raw"], "--raw: triplet.zmx is no run folder but a lens"),
        (["triplet.zmx", "blocks.png", "--checkpoint", "best"], "--checkpoint: triplet.zmx is no"),
        (["published/cassegrain_hoo_v2c18_3", "blocks.png"], "surface 1 is a mirror"),
        (["published/fisheye_us5949588_t8", "blocks.png"], "too wide a field for a picture"),
        (["published/singlet_edmund_49847", "blocks.png"], "give the sensor's width and height"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, message):
    done = CliRunner().invoke(app, ["apply", *words])
    assert isinstance(done.exception, InputError), done.output
    assert message in str(done.exception) and "\n" not in str(done.exception)


def test_a_run_is_not_taken_for_a_lens(tiny_run, work):
    Image.new("RGB", (32, 32)).save(work / "a.png")
    for option in ("--light=30", "--read-noise=2", "--bayer", "--sensor=3x2", "--pitch=4"):
        done = CliRunner().invoke(app, ["apply", str(tiny_run), "a.png", option])
        name = option.partition("=")[0]
        assert str(done.exception).startswith(f"{name}: ") and "sensor is its own" in str(
            done.exception
        )
