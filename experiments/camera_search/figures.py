"""Figures of cameras that were made of the forms of a search."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.camera_search.forms import SearchedForm
from dolens.experiments.camera_search.rungs import Rung, RungOfForm
from dolens.experiments.running.finished_run import load_run
from dolens.plotting.pareto import CamerasOfRung, spots_and_cameras_figure
from dolens.plotting.pictures import comparison_figure
from dolens.reconstruction import psnr_db
from dolens.sensor.colour import linear_to_srgb

# Views of each camera that are shown: the first and the last of its zones.
_SHOWN = 2


def cameras_picture(
    forms: Sequence[SearchedForm], rungs: Sequence[Rung], score: str, name: str
) -> Figure:
    """Draw the score of every camera at every rung against the spot of its form."""
    drawn = []
    for rung in rungs:
        kept = [f for f in forms if f.name in rung.forms and not rung.forms[f.name].failed]
        reached = [rung.forms[form.name] for form in kept]
        drawn.append(
            CamerasOfRung(
                f"{rung.epochs} epochs",
                [form.name.removeprefix("form_").lstrip("0") for form in kept],
                [form.rms_spot_um for form in kept],
                [form.decides for form in reached],
                [form.deviation(f"val/{score}") for form in reached],
            )
        )
    label = f"{score} of restored validation photographs"
    return spots_and_cameras_figure(
        drawn, label, f"{name}: spots and cameras, by number of the form"
    )


@torch.no_grad()
def images_picture(rung: Rung, best_spots: str) -> Figure | None:
    """Draw truth, measured and restored images of the best camera and of that of the best spots."""
    cameras = {"best camera": rung.best}
    other = rung.forms.get(best_spots)
    if other is not None and not other.failed and other is not rung.best:
        cameras["best spots"] = other
    parts = [_images(label, camera) for label, camera in cameras.items()]
    truth, raw, restored = (
        torch.cat(images) for images in zip(*(p[0] for p in parts), strict=True)
    )
    labels = [label for part in parts for label in part[1]]
    quality = {
        "raw": psnr_db(raw, truth).tolist(),
        "restored": psnr_db(restored, truth).tolist(),
    }
    title = "One crop of a test photograph, PSNR of this crop; display-encoded (sRGB)"
    return comparison_figure(truth, raw, restored, labels, quality, title)


def _images(label: str, camera: RungOfForm) -> tuple[tuple[Tensor, Tensor, Tensor], list[str]]:
    """Return truth, measured and restored images of some views, and the names of these."""
    run = load_run(
        camera.cameras[0].task.folder, with_loss=False, trust=True
    )  # this search has made it
    module = run.module
    assert isinstance(module, CameraModule)  # it has a score
    run.data.setup("test")
    crop = next(iter(run.data.test_dataloader()))[:1]
    taken, functions = module.take(module.variables(), crop, "test", 0)
    restored = module.restore(taken, functions).clamp(0.0, 1.0)
    labels = [name for name in module.views.labels() if name != "field"]
    chosen = sorted({0, len(labels) - 1})[:_SHOWN]
    images = (taken.truth[0], linear_to_srgb(taken.raw)[0], restored[0])
    truth, raw, found = (image[chosen] for image in images)
    return (truth, raw, found), [f"{label}\n({camera.form}), {labels[n]}" for n in chosen]
