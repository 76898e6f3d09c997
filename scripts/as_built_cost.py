"""Measure what a training step through lenses that are made costs beside one through the drawing.

    python scripts/as_built_cost.py experiment=phone_camera_as_built --rounds 20

Arms take turns, one step each: the lens as drawn, then 1, 2 and 4 lenses of a batch.  Seconds are
of the process's own CPU time, the median of all rounds.  Peak memory is that of a process that
makes steps of one arm alone; --arm K runs such a process and prints it (0: as drawn).
"""

import argparse
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.experiments.camera.made_lenses import restored_in_parts, training_images
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_module
from scripts.composed import composed

ARMS = (0, 1, 2, 4)


def step_of(overrides: list[str], lenses: int) -> Callable[[], None]:
    """Return a training step without its optimizer: images, restoration, loss, backward pass.

    Args:
        overrides: of an experiment with tolerances.
        lenses: of a step; 0: the lens as drawn.
    """
    arm = ["as_built.train=false"] if lenses == 0 else [f"as_built.lenses_per_step={lenses}"]
    with composed([*overrides, *arm]) as cfg:
        camera: Any = build_module(RunSettings.of(cfg))
        data: Any = instantiate(cfg.data)
    data.setup("fit")
    batch = next(iter(data.train_dataloader()))

    def step() -> None:
        values = camera.variables()
        taken, functions = training_images(camera, camera.manufacture, values, batch, None)
        restored = restored_in_parts(camera, taken, functions)
        camera.loss_over_views(restored, taken.truth.to(restored.dtype))["total"].backward()

    return step


def main() -> None:
    """Print a row for each arm."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="+")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--arm", type=int)
    given = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    if given.arm is not None:
        step = step_of(given.overrides, given.arm)
        for _ in range(5):
            step()
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
        return
    steps = {lenses: step_of(given.overrides, lenses) for lenses in ARMS}
    seconds: dict[int, list[float]] = {lenses: [] for lenses in ARMS}
    for number in range(given.rounds + 1):
        for lenses, step in steps.items():
            start = time.process_time()
            step()
            if number:  # the first compiles
                seconds[lenses].append(time.process_time() - start)
    for lenses in ARMS:
        arm = [sys.executable, __file__, *given.overrides, "--arm", str(lenses)]
        memory = float(subprocess.run(arm, capture_output=True, text=True, check=True).stdout)
        name = "as drawn" if lenses == 0 else f"{lenses} lenses"
        low, middle, high = statistics.quantiles(seconds[lenses], n=4)
        print(f"{name}: {middle:.3f} s [{low:.3f}, {high:.3f}] CPU a step, {memory:.0f} MB")


if __name__ == "__main__":
    main()
