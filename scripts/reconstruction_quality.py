"""Compare networks behind one fixed lens: image quality against seconds of training.

    python scripts/reconstruction_quality.py images --folder outputs/reconstruction
    python scripts/reconstruction_quality.py train --folder outputs/reconstruction --seconds 20 70
    python scripts/reconstruction_quality.py show --folder outputs/reconstruction --figure FILE.png

Images are made once; then every network trains for the same process time of one thread, so that
other programs on the machine do not count.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch

from dolens.errors import InputError
from dolens.plotting import save_figure
from dolens.plotting.runs import quality_figure
from dolens.reconstruction import Restoration
from scripts.reconstruction.fixed_optics import FixedOptics, composed_network, fixed_optics
from scripts.reconstruction.known_depth import known_depth
from scripts.reconstruction.results import Result, curves, read, table, write
from scripts.reconstruction.training import TrainedFor, restored, scores, train_for

# The lens that `experiment=wavefront_coding` learns with its default seed, before this comparison.
LENS = (
    "variables={sensor_distance: {initial: 95.8045}, surfaces.5.x3: {initial: 8.788e-6}, "
    "surfaces.5.x2y: {initial: 5.430e-6}, surfaces.5.xy2: {initial: 3.936e-6}, "
    "surfaces.5.y3: {initial: 8.345e-6}}"
)
EXPERIMENT = (
    "experiment=wavefront_coding",
    "renderer=psf_narrow",
    "loss.perceptual=none",
    "miscalibrations=none",
    "reference_renderers=none",
    "data.steps_per_epoch=300",
    LENS,
)
PACKAGES = ("data=package_photographs", "data.evaluation_crops_per_photograph=1")
NETWORKS: dict[str, tuple[str, ...]] = {
    "unet": ("network=unet",),
    "nafnet": ("network=nafnet",),
    "wiener_unet": ("network=wiener_unet",),
    "wiener_nafnet": ("network=wiener_nafnet",),
    "unrolled_splitting": ("network=unrolled_splitting",),
    "feature_wiener": ("network=feature_wiener",),
    "feature_wiener, features": (
        "network=feature_wiener",
        "network.features=4",
        "network.scales=2",
    ),
    "feature_wiener, depths": ("network=feature_wiener", "network.depths=3"),
    "feature_wiener, width 24": ("network=feature_wiener", "network.width=24"),
    "wiener_tv": ("network=wiener_tv",),
    "wiener_bm3d": ("network=wiener_bm3d",),
}
ORACLE = "feature_wiener, depth known"
BASELINE = "wiener_unet"


def images(folder: Path, package_folders: Sequence[str]) -> dict[str, FixedOptics]:
    """Return the lens's images of the default's photographs, and of 42 others if they are there."""
    found = {"photos": fixed_optics(folder / "photos.pt", EXPERIMENT)}
    file = folder / "packages.pt"
    if package_folders or file.is_file():
        folders = [f"data.folders=[{','.join(package_folders)}]"] if package_folders else []
        found["packages"] = fixed_optics(file, [*EXPERIMENT, *PACKAGES, *folders], training=False)
    return found


def maker(name: str) -> Callable[[], Restoration]:
    """Return what makes the network of a name in `NETWORKS`, or the oracle."""
    if name == ORACLE:
        return known_depth
    return partial(composed_network, [*EXPERIMENT, *NETWORKS[name]])


def train(
    folder: Path, names: Sequence[str], seconds: Sequence[float], seeds: Sequence[int]
) -> None:
    """Train and judge what has no file yet; a line each."""
    optics = images(folder, [])
    for seed in seeds:
        for name in names:
            for limit in seconds:
                file = folder / f"{name.replace(', ', '_').replace(' ', '_')}_{limit:g}_{seed}.json"
                if file.is_file():
                    continue
                done = train_for(maker(name), optics["photos"], limit, seed)
                result = _judged(name, seed, limit, done, optics)
                write(result, file)
                torch.save(done.network.state_dict(), file.with_suffix(".weights"))
                worst = {k: f"{v.mean(0).min():.2f}" for k, v in result.scores.items()}
                print(f"{name}, seed {seed}: {done.steps} steps, {done.seconds:.0f} s, {worst}")


def _judged(
    name: str, seed: int, limit: float, done: TrainedFor, optics: dict[str, FixedOptics]
) -> Result:
    found = {
        "validation": scores(done.network, optics["photos"], "validation"),
        "test": scores(done.network, optics["photos"], "test"),
    }
    if "packages" in optics:
        found["packages"] = scores(done.network, optics["packages"], "test")
    parameters = sum(p.numel() for p in done.network.parameters())
    return Result(name, seed, limit, done.seconds, done.steps, parameters, found)


def pictures(folder: Path, file: Path, judge: str, crops: Sequence[int]) -> None:
    """Write a PNG of restored crops: truth, raw, and every trained network of the first seed."""
    from PIL import Image

    optics = images(folder, [])[judge]
    results = [r for r in read(folder) if r.seed == 0]
    longest = max(r.limit for r in results)
    rows = []
    for crop in crops:
        split = optics.splits["test"]
        row = [split.truth[crop].float(), optics.raw(split.images[crop], 0)[0].clamp(0, 1) ** 0.45]
        for result in (r for r in results if r.limit == longest and r.name in _SHOWN):
            network = maker(result.name)()
            stem = f"{result.name.replace(', ', '_').replace(' ', '_')}_{result.limit:g}_0"
            weights = torch.load(folder / f"{stem}.weights", weights_only=True)
            network.load_state_dict(weights)
            row.append(restored(network.eval(), optics, "test", crop)[0])
        rows.append(torch.cat(row, dim=-1))
    array = (torch.cat(rows, dim=-2).permute(1, 2, 0) * 255).round().byte().numpy()
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(file)


_SHOWN = (BASELINE, "wiener_nafnet", "unrolled_splitting", "feature_wiener")


def main(arguments: Sequence[str]) -> int:
    """Make images, train, or show a table and a figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("images", help="the lens's images of photographs")
    making.add_argument("--package-folders", nargs="*", default=[], help="of data.folders")
    training = commands.add_parser("train", help="train networks")
    usual = [name for name in NETWORKS if name != "wiener_bm3d"]  # whose package is not for all
    training.add_argument("--networks", nargs="+", default=usual, choices=[*NETWORKS, ORACLE])
    training.add_argument("--seconds", nargs="+", type=float, default=[20.0, 70.0])
    training.add_argument("--seeds", nargs="+", type=int, default=[0])
    show = commands.add_parser("show", help="a table, and a figure")
    show.add_argument("--figure", type=Path)
    show.add_argument("--pictures", type=Path)
    show.add_argument("--crops", nargs="+", type=int, default=[0, 1, 2, 3])
    show.add_argument("--judge", default="packages", choices=["photos", "packages"])
    for part in (making, training, show):
        part.add_argument("--folder", type=Path, default=Path("outputs/reconstruction"))
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        if given.command == "images":
            images(given.folder, given.package_folders)
        elif given.command == "train":
            train(given.folder, given.networks, given.seconds, given.seeds)
        else:
            found = read(given.folder)
            print("\n".join(table(found, BASELINE)))
            if given.figure:
                save_figure(quality_figure(curves(found)), given.figure)
            if given.pictures:
                pictures(given.folder, given.pictures, given.judge, given.crops)
    except InputError as problem:
        parser.error(str(problem))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
