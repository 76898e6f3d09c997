"""Point spread functions: error against very many rays, and time."""

from collections.abc import Sequence

import torch

from dolens.experiments.speed.renders import Subject
from dolens.experiments.speed.timing import by_turns
from dolens.rendering.auto.field_grid import spread_pixels, survey
from dolens.rendering.auto.probes import grey_levels
from dolens.rendering.imaging_system import ImagingSystem

_POINTS, _TRUE_SAMPLES, _SIZE = 9, 160, 65


@torch.no_grad()
def function_rows(
    subject: Subject, samples: Sequence[int], seconds: float
) -> list[dict[str, float | str]]:
    """Return a row for each number of rays: error in grey levels on the probe, time a function.

    Args:
        subject: the scene.
        samples: strata along each side of the pupil.
        seconds: that timing may take.
    """
    imaging = ImagingSystem.of(subject.lens.system(), subject.scene, subject.sensor)
    places = spread_pixels(subject.sensor, _POINTS)

    def functions(count: int, seed: int) -> torch.Tensor:
        found = survey(imaging, places, count, seed)
        return found.functions(_SIZE, found.chief is not None)

    truth = functions(_TRUE_SAMPLES, 0)
    times = by_turns({str(n): lambda n=n: functions(n, 1) for n in samples}, seconds)
    each = _POINTS * truth.shape[1] * truth.shape[2]
    return [
        {
            "scene": subject.name,
            "part": "psf",
            "model": "psf",
            "setting": f"{n * n} rays",
            "error_grey_levels": float(grey_levels(functions(n, 1) - truth).square().mean().sqrt()),
            "forward_s": times[str(n)] / each,
        }
        for n in samples
    ]
