"""Judge restorers behind lenses that the general one has not seen.

    python scripts/restoration_of_lenses.py --package-folders FOLDER/usr/share --light 30 100 1000
    python scripts/restoration_of_lenses.py ... --wrong focus tolerances --restorers bm3d general
    python scripts/restoration_of_lenses.py ... --flat --lenses "phase plate, 6 m"

The 42 test photographs of data=package_photographs are blurred by each lens, get the noise of a
sensor with 3 electrons of read noise, and are restored.  Intervals are 95 %, over photographs.

`--wrong` blurs by another lens, of which restorers are told or not: `focus` moves the sensor until
the blur is a pixel wider, `tolerances` draws a lens within the usual ones.  `--flat` shows the
residual deviations in the ten flattest squares of 16 pixels, sRGB over 255.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.diffraction.pupil_fit import RegularPupil, regular_pupil
from dolens.errors import InputError
from dolens.experiments.data.package_photographs import (
    PackagePhotographsDataModule,
    data_folders,
)
from dolens.experiments.pretraining.pixel_functions import pixel_functions
from dolens.experiments.pretraining.pretraining import blurred
from dolens.experiments.pretraining.random_pupils import Draw, fitted_pupils, within_tolerances
from dolens.prescriptions.files import load_lens
from dolens.reconstruction import (
    GeneralRestoration,
    Restoration,
    WienerBM3DRestoration,
    WienerTVRestoration,
    psnr_db,
    structural_similarity,
)
from dolens.reconstruction.quality import gain_interval
from dolens.rendering.psf import axial_point_spread_functions
from dolens.scene.planar import PlanarScene
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

SIDE, MARGIN, SCALE = 128, 32, 1.5


class Judge(NamedTuple):
    """A lens at a field on a sensor.

    Attributes:
        lens: file, or name in conf/lens.
        field: degrees, or mm where objects are near.
        pitch: of the pixels, µm.
        shift: of the sensor from where the file has it, mm.
    """

    lens: str
    field: tuple[float, float]
    pitch: float
    shift: float = 0.0


JUDGES = {
    "telephoto": Judge("published/telephoto_smith_p175_sigler", (0.0, 0.7), 4.0),
    "doublet of a large field": Judge("large_fov_doublet_designed", (0.0, 15.0), 20.0),
    "triplet, corner of the field": Judge("cooke_triplet", (0.0, 20.0), 8.0),
    "Tessar": Judge("published/tessar_us2573511_ex1", (0.0, 15.0), 10.0),
    "singlet": Judge("la1131", (0.0, 0.0), 60.0),
    "double Gauss, out of focus": Judge("double_gauss", (0.0, 0.0), 15.0, 0.15),
    "free of blur": Judge("cooke_triplet", (0.0, 0.0), 40.0),
}
# The doublet with a phase plate, as the default experiment learned it once, and without one; for
# depths of which restorers are told all, not which it is.
DOUBLETS = {
    "phase plate": {
        "sensor_distance": 95.8045,
        "surfaces.5.x3": 8.788e-6,
        "surfaces.5.x2y": 5.430e-6,
        "surfaces.5.xy2": 3.936e-6,
        "surfaces.5.y3": 8.345e-6,
    },
    "plain doublet": {"sensor_distance": 95.86},
}
PITCH, DEPTHS, LINES = 6.9, (8000.0, 6000.0, 4500.0), (656.2725, 587.5618, 486.1327)
AT_DEPTHS = {
    f"{kind}, {depth / 1e3:g} m": (kind, number)
    for kind in DOUBLETS
    for number, depth in enumerate(DEPTHS)
}
WRONG = ("focus", "tolerances")
# Sides of the squares that --flat looks at, and how many.
FLAT_SIDE, FLAT_COUNT = 16, 10
RESTORERS: dict[str, Callable[[], Restoration]] = {
    "tv": WienerTVRestoration,
    "bm3d": WienerBM3DRestoration,
    "general": GeneralRestoration,
    "by_depth": partial(GeneralRestoration, by_depth=True),
    "known": GeneralRestoration,  # is told the one function of the image's own depth
}
COLOURS = (620.0, 630.0, 535.0, 545.0, 455.0, 465.0)  # nm, two for each of red, green and blue


@torch.no_grad()
def functions_of(name: str, wrong: str | None = None) -> Tensor:
    """Return the point spread functions (D, 3, 65, 65) of a lens, or of a wrong one instead.

    Args:
        name: of `JUDGES`, with D = 1, or of `AT_DEPTHS`, with D = 3.
        wrong: one of `WRONG`; see above.

    Raises:
        InputError: the lens has no smooth wavefront there.
    """
    at_depths = name in AT_DEPTHS
    lens = load_lens("wavefront_coding" if at_depths else JUDGES[name].lens, dtype=torch.float64)
    pitch = 1e-3 * (PITCH if at_depths else JUDGES[name].pitch)
    if at_depths:
        parameters = dict(lens.named_parameters())
        for key, value in DOUBLETS[AT_DEPTHS[name][0]].items():
            parameters[key].fill_(value)
    if wrong == "tolerances":
        lens = within_tolerances(lens, Draw(torch.Generator().manual_seed(0)), 1.0)
    defocus = pitch * float(lens.first_order().f_number) if wrong == "focus" else 0.0
    if at_depths:
        lens.sensor_distance.add_(defocus)
        scene, sensor = PlanarScene(DEPTHS, LINES), Sensor(SIDE, SIDE, pitch)
        found = axial_point_spread_functions(lens, scene, sensor, 65, 48, centred=True)
        return (found / found.sum((-2, -1), keepdim=True)).float()
    judge = JUDGES[name]
    fit = fitted_pupils(lens, judge.field, COLOURS, lateral_colour=True)
    if fit is None:
        raise InputError(f"{judge.lens}: no smooth wavefront at the field {judge.field}")

    def at(samples: int) -> RegularPupil:
        return regular_pupil(fit, samples)

    found, held = pixel_functions(at, [judge.shift + defocus], pitch)
    if held < 0.9:
        raise InputError(f"{judge.lens}: a window of 65 pixels holds {held:.2f} of the light")
    return found.unflatten(1, (3, -1)).mean(2).float()


def scenes_of(folders: Sequence[Path], split: str = "test", margin: int = MARGIN) -> Tensor:
    """Return the middles of the photographs of a split with margins, linear light, (P, 3, S, S).

    Args:
        folders: of `data=package_photographs`.
        split: `val` (14) or `test` (42).
        margin: pixels at each edge.
    """
    data = PackagePhotographsDataModule(
        folders=[str(folder) for folder in folders],
        crop_size=SIDE,
        margin=margin,
        evaluation_crops_per_photograph=1,
        evaluation_scale=SCALE,
    )
    return torch.cat(list(data.val_dataloader() if split == "val" else data.test_dataloader()))


class Pictures(NamedTuple):
    """Photographs behind a lens.

    Attributes:
        truth: (N, 3, H, W), sRGB.
        restored: the same by each restorer, within 0 and 1.
        seconds: of the processor, a picture of each restorer.
    """

    truth: Tensor
    restored: dict[str, Tensor]
    seconds: dict[str, float]


def main(arguments: Sequence[str]) -> int:
    """Print a table for each level of light."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--package-folders", nargs="*", type=Path, default=data_folders())
    parser.add_argument("--light", nargs="+", type=float, default=[100.0], help="electrons")
    names = [*AT_DEPTHS, *JUDGES]
    parser.add_argument("--lenses", nargs="+", default=names, choices=names)
    parser.add_argument("--restorers", nargs="+", default=["tv", "general"], choices=RESTORERS)
    parser.add_argument("--wrong", nargs="*", default=[], choices=WRONG)
    parser.add_argument("--flat", action="store_true", help="residuals in flat squares")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        scenes = scenes_of(given.package_folders)
        restorers = {name: RESTORERS[name]().eval() for name in given.restorers}
        for light in given.light:
            print(f"\n{light:g} electrons in white\n")
            print(f"| lens | restorer | dB | SSIM | ahead of {given.restorers[0]} | on | s |")
            print("|---|---|---|---|---|---|---|")
            for name in given.lenses:
                told = [(wrong, told) for wrong in given.wrong for told in (True, False)]
                for wrong, is_told in ((None, True), *told):
                    found = pictures(name, wrong, is_told, light, scenes, restorers)
                    label = f"{name}, {wrong}{'' if is_told else ' not told'}" if wrong else name
                    for line in rows(label, found):
                        print(line, flush=True)
                    if given.flat:
                        print(*flat_lines(found), sep="\n", flush=True)
    except InputError as problem:
        parser.error(str(problem))
    return 0


@torch.no_grad()
def pictures(
    name: str,
    wrong: str | None,
    is_told: bool,
    light: float,
    scenes: Tensor,
    restorers: Mapping[str, Restoration],
) -> Pictures:
    """Return photographs behind a lens and by every restorer, which is told of it or of the right
    one; arguments as of `functions_of`.
    """
    made = functions_of(name, wrong)
    told = made if is_told else functions_of(name)
    readout = Readout.at_light(light, max(light, 8180.0), read_noise=3.0 / max(light, 8180.0))
    noise = torch.tensor(readout.noise)
    inner = (..., slice(MARGIN, MARGIN + SIDE), slice(MARGIN, MARGIN + SIDE))
    imaged = AT_DEPTHS[name][1] if name in AT_DEPTHS else 0
    image = blurred(scenes, made[imaged])[inner].clamp(min=0.0)
    raw = readout.develop(readout(image, torch.Generator().manual_seed(0)))
    restored, seconds = {}, {}
    for label, network in restorers.items():
        begun = time.process_time()
        own = told[imaged : imaged + 1] if label == "known" else told
        found = torch.cat([network(one[None], own, None, noise) for one in raw])
        seconds[label] = (time.process_time() - begun) / len(raw)
        restored[label] = found.clamp(0.0, 1.0)
    return Pictures(linear_to_srgb(scenes[inner]), restored, seconds)


def rows(name: str, found: Pictures) -> Iterator[str]:
    """Yield a line of the table for each restorer behind a lens, the first one's first."""
    truth = found.truth
    scored = {
        label: (psnr_db(restored, truth), structural_similarity(restored, truth))
        for label, restored in found.restored.items()
    }
    first, similar = next(iter(scored.values()))
    for label, (psnr, ssim) in scored.items():
        own, other = psnr[None, :, None], first[None, :, None]
        generator = torch.Generator().manual_seed(0)
        gain = gain_interval(own, other, lambda means: means.squeeze(-1), generator)
        yield (
            f"| {name} | {label} | {float(psnr.mean()):.2f} | {float(ssim.mean()):.3f} "
            f"| {gain.estimate:+.2f} [{gain.low:+.2f}, {gain.high:+.2f}] "
            f"| {int((psnr > first).sum())}, {int((ssim > similar).sum())} "
            f"| {found.seconds[label]:.2f} |"
        )


def flat_lines(found: Pictures) -> Iterator[str]:
    """Yield a line for each of the flattest squares, at most one of a photograph."""
    squares = found.truth.unfold(-2, FLAT_SIDE, FLAT_SIDE).unfold(-2, FLAT_SIDE, FLAT_SIDE)
    # Neither black nor white, where clipping hides noise.
    mean, deviation = squares.mean((1, -2, -1)), squares.std((-2, -1)).amax(1)
    deviation = torch.where((mean > 0.15) & (mean < 0.85), deviation, 1.0).flatten(1)
    least, places = deviation.min(dim=1)
    for number in least.argsort()[:FLAT_COUNT].tolist():
        row, column = divmod(int(places[number]), squares.shape[3])
        cut = (
            number,
            slice(None),
            *(slice(FLAT_SIDE * n, FLAT_SIDE * (n + 1)) for n in (row, column)),
        )
        errors = {
            k: 255.0 * float((v[cut] - found.truth[cut]).std()) for k, v in found.restored.items()
        }
        shown = ", ".join(f"{label} {value:.2f}" for label, value in errors.items())
        place = f"photograph {number}, row {FLAT_SIDE * row}, column {FLAT_SIDE * column}"
        yield f"  {place}: truth {255.0 * float(least[number]):.2f}; {shown}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
