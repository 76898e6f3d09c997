"""Measure what cameras for an extended depth of field gain over the best plain lens.

    python scripts/coding_gain.py bound                # by linear filters: a minute, no photographs
    python scripts/coding_gain.py judge --package-folders FOLDER/usr/share --figure coding_gain.png
    python scripts/coding_gain.py judge --families "bracket of 3" --motions 0:known 0.5:estimated
    python scripts/coding_gain.py scene --lights 1000 --figure scene.png

The plain lens is the same one without its plate, refocused for each light, and stopped down as far
as validation photographs choose, at equal exposure time.  Other cameras have the settings of least
error by linear filters: strength of the plate, foci, F-number; validation moves all of a camera's
foci together by a step.  All are judged by wave optics on 42 photographs at each depth, restored by
the shipped restorer: blind to depth, or choosing it by place.  `light` is electrons in white at
F/8, read noise 3 electrons a readout.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import format_interval
from dolens.experiments.data.package_photographs import data_folders
from dolens.plotting import save_figure
from dolens.plotting.pareto import GainRange, coding_gain_figure
from scripts.coding.cameras import (
    F_NUMBERS,
    Bound,
    DepthCamera,
    Range,
    Shot,
    best_of,
    refined,
    refocused,
)
from scripts.coding.judged import (
    MARGIN,
    RESTORERS,
    Motion,
    gain_at_worst,
    gain_of_mean,
    restorer_of,
    scene_figure,
    scene_of,
    scikit_image_scenes,
    scores_of,
)
from scripts.restoration_of_lenses import scenes_of

RANGES = {
    "4.5 to 8 m": Range((8000.0, 6000.0, 4500.0)),
    "3 m to 116 m": Range((116000.0, 5760.0, 2953.0)),
    "4.5 to 8 m, 2.3 µm": Range((8000.0, 6000.0, 4500.0), 0.0023),
}
LIGHTS = (10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0)
FAMILIES = (
    "cubic",
    "fixed cubic",
    "quartic",
    "sweep",
    "bracket of 2",
    "bracket of 3",
    "bracket of 5",
    "learned bracket of 3",
)


def chosen(family: str, shot: Shot, known: bool) -> tuple[DepthCamera, Bound]:
    """Return a family's camera of least error by linear filters, and its errors."""
    equal = family.removeprefix("learned ")
    camera, bound = best_of(equal, shot, known)
    if equal != family:
        camera, bound = refined(camera, shot, known)
    return camera, bound


def bounds(
    scene: Range, lights: Sequence[float], families: Sequence[str]
) -> dict[str, list[tuple[float, float]]]:
    """Return gains in dB over the best plain lens by family and light: with one filter for all
    depths, and with one for each.
    """
    found: dict[str, list[tuple[float, float]]] = {family: [] for family in families}
    for light in lights:
        shot = Shot(scene, light)
        least = [
            min(chosen(f"plain F/{n:g}", shot, known)[1][known] for n in F_NUMBERS)
            for known in (False, True)
        ]
        for family in families:
            own = [chosen(family, shot, known)[1][known] for known in (False, True)]
            common, each = (10.0 * math.log10(a / b) for a, b in zip(least, own, strict=True))
            found[family].append((common, each))
    return found


def best_on_validation(
    cameras: Sequence[DepthCamera], shot: Shot, restorer: str, validation: Tensor
) -> DepthCamera:
    """Return the camera whose worst depth is best on validation photographs."""
    network = restorer_of(restorer)

    def score(camera: DepthCamera) -> float:
        return float(scores_of(camera, shot, validation, network).mean(0).amin())

    return max(cameras, key=score)


def judge(
    shot: Shot,
    restorer: str,
    families: Sequence[str],
    photographs: tuple[Tensor, Tensor],
    motions: Sequence[Motion],
) -> dict[str, tuple[float, float, float]]:
    """Print a table's rows, and return gains at the worst depth with their intervals, by family."""
    validation, test = photographs
    network, known = restorer_of(restorer), restorer == "by depth"
    stops = [chosen(f"plain F/{n:g}", shot, known)[0] for n in F_NUMBERS]
    judges = (shot, restorer, validation)
    plain = best_on_validation(stops, *judges)
    plain = best_on_validation(refocused(plain, shot.scene), *judges)
    reference = scores_of(plain, shot, test, network)
    _print_row(shot.light, restorer, plain, reference)
    found = {}
    for family in families:
        camera, _ = chosen(family, shot, known)
        camera = best_on_validation(refocused(camera, shot.scene), *judges)
        several = len(camera.foci) > 1 and not camera.one
        for motion in motions if several else (Motion(),):
            scores = scores_of(camera, shot, test, network, motion)
            gain = gain_at_worst(scores, reference)
            moving = f", motion {motion.pixels:g} {motion.knowledge}" if motion.pixels else ""
            _print_row(shot.light, restorer, camera, scores, reference, moving)
            found[f"{family}{moving}"] = (gain.estimate, gain.low, gain.high)
    return found


def draw_scene(light: float, families: Sequence[str], folders: Sequence[Path], file: Path) -> int:
    """Write the figure of scikit-image's three test photographs side by side, at three depths.

    Raises:
        InputError: no file is given.
    """
    if file is None:
        raise InputError("scene: --figure FILE is missing")
    name, scene = next(iter(RANGES.items()))
    shot = Shot(scene, light)
    validation = scenes_of(folders, "val", MARGIN)
    photographs = scikit_image_scenes()[: len(scene.depths)]
    restorer = "by depth"
    stops = [chosen(f"plain F/{n:g}", shot, True)[0] for n in F_NUMBERS]
    plain = best_on_validation(stops, shot, restorer, validation)
    cameras = [plain, *(chosen(family, shot, True)[0] for family in families)]
    network = restorer_of(restorer)
    rows = {
        c.family if c is plain else f"{c.family}, F/{c.f_number:g}": scene_of(
            c, shot, photographs, network
        )
        for c in cameras
    }
    depths = ", ".join(f"{depth / 1e3:g}" for depth in scene.depths)
    save_figure(scene_figure(rows, f"{name}: {depths} m; {light:g} electrons in white"), file)
    return 0


def _print_row(
    light: float,
    restorer: str,
    camera: DepthCamera,
    scores: Tensor,
    reference: Tensor | None = None,
    note: str = "",
) -> None:
    means = scores.mean(dim=0)
    depths = " / ".join(f"{value:.2f}" for value in means.tolist())
    gains = ["", ""]
    if reference is not None:
        gains = [
            format_interval(gain(scores, reference), 2) for gain in (gain_at_worst, gain_of_mean)
        ]
    cells = [f"{light:g}", restorer, camera.family + note, camera.described(), depths, *gains]
    print(f"| {' | '.join(cells)} |", flush=True)


def main(arguments: Sequence[str]) -> int:
    """Print tables, and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=("bound", "judge", "scene"))
    parser.add_argument("--ranges", nargs="+", choices=RANGES, default=list(RANGES)[:2])
    parser.add_argument("--lights", nargs="+", type=float, default=LIGHTS, help="electrons")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=FAMILIES)
    parser.add_argument("--restorers", nargs="+", choices=RESTORERS, default=["blind", "by depth"])
    parser.add_argument("--motions", nargs="+", default=["0:known"], help="pixels:what is known")
    parser.add_argument("--package-folders", nargs="*", type=Path, default=data_folders())
    parser.add_argument("--photographs", type=int, help="of the 42, evenly chosen")
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        pairs = [text.split(":") for text in given.motions]
        motions = [Motion(float(pixels), knowledge) for pixels, knowledge in pairs]
        if given.command == "scene":
            return draw_scene(given.lights[0], given.families, given.package_folders, given.figure)
        shown = []
        for name in given.ranges:
            scene = RANGES[name]
            found = bounds(scene, given.lights, given.families)
            print(f"\n{name}: gains in dB by linear filters, one for all depths / one for each\n")
            print(f"| light | {' | '.join(found)} |\n|{'---|' * (len(found) + 1)}")
            for number, light in enumerate(given.lights):
                cells = [
                    f"{rows[number][0]:+.2f} / {rows[number][1]:+.2f}" for rows in found.values()
                ]
                print(f"| {light:g} | {' | '.join(cells)} |")
            points: dict[str, dict[float, tuple[float, float, float]]] = {}
            if given.command == "judge":
                validation, test = (
                    scenes_of(given.package_folders, split, MARGIN) for split in ("val", "test")
                )
                count = min(given.photographs or len(test), len(test))
                chosen_ones = torch.linspace(0, len(test) - 1, count).round().long()
                photographs = validation, test[chosen_ones]
                print(
                    f"\n{name}: PSNR in dB of restored photographs by depth; gains over the best "
                    "plain lens at the worst depth and of the mean, 95 %\n\n"
                    "| light | restored | camera | settings | depths | worst | mean |\n"
                    "|---|---|---|---|---|---|---|"
                )
                for light in given.lights:
                    for restorer in given.restorers:
                        shot = Shot(scene, light)
                        judged = judge(shot, restorer, given.families, photographs, motions)
                        for family, gain in judged.items():
                            points.setdefault(f"{family}, {restorer}", {})[light] = gain
            shown.append(GainRange(name, given.lights, found, points))
        if given.figure:
            save_figure(coding_gain_figure(shown), given.figure)
    except InputError as problem:
        parser.error(str(problem))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
