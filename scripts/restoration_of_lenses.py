"""Judge restorers behind lenses that the general one has not seen.

    python scripts/restoration_of_lenses.py --package-folders FOLDER/usr/share --light 30 100 1000

The 42 test photographs of data=package_photographs are blurred by each lens, get the noise of a
sensor with 3 electrons of read noise, and are restored.  Intervals are 95 %, over photographs.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from torch import Tensor

from dolens.diffraction.pupil_fit import RegularPupil, regular_pupil
from dolens.errors import InputError
from dolens.experiments.data.package_photographs import (
    PackagePhotographsDataModule,
    data_folders,
)
from dolens.experiments.pretraining.examples import blurred
from dolens.experiments.pretraining.pixel_functions import pixel_functions
from dolens.experiments.pretraining.traced_pupils import fitted_pupils
from dolens.prescriptions.files import load_lens
from dolens.reconstruction import (
    GeneralRestoration,
    Restoration,
    WienerBM3DRestoration,
    WienerTVRestoration,
    psnr_db,
    structural_similarity,
)
from dolens.reconstruction.intervals import gain_interval
from dolens.sensor.colour import linear_to_srgb
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
RESTORERS = {
    "tv": WienerTVRestoration,
    "bm3d": WienerBM3DRestoration,
    "general": GeneralRestoration,
}
COLOURS = (620.0, 630.0, 535.0, 545.0, 455.0, 465.0)  # nm, two for each of red, green and blue


@torch.no_grad()
def functions_of(judge: Judge) -> Tensor:
    """Return the point spread functions of a judge's colours, (1, 3, 65, 65).

    Raises:
        InputError: the lens has no smooth wavefront there.
    """
    lens = load_lens(judge.lens, dtype=torch.float64)
    fit = fitted_pupils(lens, judge.field, COLOURS, lateral_colour=True)
    if fit is None:
        raise InputError(f"{judge.lens}: no smooth wavefront at the field {judge.field}")

    def at(samples: int) -> RegularPupil:
        return regular_pupil(fit, samples)

    found, held = pixel_functions(at, [judge.shift], 1e-3 * judge.pitch)
    if held < 0.9:
        raise InputError(f"{judge.lens}: a window of 65 pixels holds {held:.2f} of the light")
    return found.unflatten(1, (3, -1)).mean(2).float()


def scenes_of(folders: Sequence[Path]) -> Tensor:
    """Return the middles of the 42 test photographs with margins, linear light, (42, 3, S, S)."""
    data = PackagePhotographsDataModule(
        folders=[str(folder) for folder in folders],
        crop_size=SIDE,
        margin=MARGIN,
        evaluation_crops_per_photograph=1,
        evaluation_scale=SCALE,
    )
    return torch.cat(list(data.test_dataloader()))


def scores(
    network: Restoration, raw: Tensor, functions: Tensor, noise: Tensor, truth: Tensor
) -> tuple[Tensor, Tensor, float]:
    """Return PSNR in dB and SSIM of each picture, and seconds of the processor a picture."""
    begun = time.process_time()
    with torch.no_grad():
        restored = torch.cat([network(one[None], functions, None, noise) for one in raw])
    seconds = (time.process_time() - begun) / len(raw)
    restored = restored.clamp(0.0, 1.0)
    return psnr_db(restored, truth), structural_similarity(restored, truth), seconds


def main(arguments: Sequence[str]) -> int:
    """Print a table for each level of light."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--package-folders", nargs="*", type=Path, default=data_folders())
    parser.add_argument("--light", nargs="+", type=float, default=[100.0], help="electrons")
    parser.add_argument("--lenses", nargs="+", default=list(JUDGES), choices=list(JUDGES))
    parser.add_argument("--restorers", nargs="+", default=["tv", "general"], choices=RESTORERS)
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
                for line in rows(name, light, scenes, restorers):
                    print(line, flush=True)
    except InputError as problem:
        parser.error(str(problem))
    return 0


def rows(
    name: str, light: float, scenes: Tensor, restorers: Mapping[str, Restoration]
) -> Iterator[str]:
    """Yield a line of the table for each restorer behind a lens, the first one's first."""
    functions = functions_of(JUDGES[name])
    readout = Readout.at_light(light, max(light, 8180.0), read_noise=3.0 / max(light, 8180.0))
    noise = torch.tensor(readout.noise)
    inner = (..., slice(MARGIN, MARGIN + SIDE), slice(MARGIN, MARGIN + SIDE))
    truth = linear_to_srgb(scenes[inner])
    image = blurred(scenes, functions[0])[inner].clamp(min=0.0)
    raw = readout.develop(readout(image, torch.Generator().manual_seed(0)))
    first: Tensor | None = None
    for label, network in restorers.items():
        psnr, ssim, seconds = scores(network, raw, functions, noise, truth)
        first = psnr if first is None else first
        own, other = psnr[None, :, None], first[None, :, None]
        generator = torch.Generator().manual_seed(0)
        gain = gain_interval(own, other, lambda means: means.squeeze(-1), generator)
        yield (
            f"| {name} | {label} | {float(psnr.mean()):.2f} | {float(ssim.mean()):.3f} "
            f"| {gain.estimate:+.2f} [{gain.low:+.2f}, {gain.high:+.2f}] "
            f"| {int((psnr > first).sum())} | {seconds:.2f} |"
        )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
