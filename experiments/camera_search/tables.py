"""Tables of cameras that were made of the forms of a search."""

from collections.abc import Iterator, Sequence

from dolens.experiments.camera_search.forms import SearchedForm
from dolens.experiments.camera_search.rungs import Rung, RungOfForm
from dolens.experiments.tables import Row


def camera_rows(forms: Sequence[SearchedForm], rungs: Sequence[Rung]) -> Iterator[Row]:
    """Yield a row for each form in the order of its spots: what it reached at every rung."""
    for rank, form in enumerate(forms, 1):
        row: dict[str, float | str] = {
            "spot_rank": rank,
            "form": form.name,
            "rms_spot_um": form.rms_spot_um,
            "rms_spot_um_over_the_sensor": form.rms_spot_um_by_area,
        }
        for rung in rungs:
            reached = rung.forms.get(form.name)
            for name in ("psnr_db", "ssim"):
                row[f"{name}_rung_{rung.number}"] = _shown(reached, f"val/{name}")
        last = rungs[-1].forms.get(form.name) if rungs else None
        for name in ("psnr_db", "ssim"):
            row[f"test_{name}"] = _shown(last, f"test/{name}")
        row["cost_s"] = sum(
            camera.metrics.get("cost/wall_s", 0.0)
            for rung in rungs
            if form.name in rung.forms
            for camera in rung.forms[form.name].cameras
        )
        failures = (rung.forms[form.name].failed for rung in rungs if form.name in rung.forms)
        row["failed"] = next((reason for reason in failures if reason), "")
        yield row


def rung_rows(rungs: Sequence[Rung]) -> Iterator[Row]:
    """Yield a row for each form of each rung, the best first.

    `behind_db` is what it lacks to the rung's best, with the interval of this difference over
    photographs, and over seeds where there are several.
    """
    for rung in rungs:
        ranked = sorted(rung.forms.values(), key=lambda f: (bool(f.failed), -f.decides))
        for form in ranked:
            behind = None if form.failed else rung.best.gain(form, rung.stage)
            yield {
                "rung": rung.number,
                "epochs": rung.epochs,
                "form": form.form,
                "seeds": len(form.cameras),
                "score": form.decides,
                "deviation_over_seeds": form.deviation(f"val/{form.score}"),
                "ssim": form.mean("val/ssim"),
                "behind_db": "" if behind is None else behind.estimate,
                "behind_low": "" if behind is None else behind.low,
                "behind_high": "" if behind is None else behind.high,
                "goes_on": form.form in rung.going_on,
                "failed": form.failed,
            }


def _shown(form: RungOfForm | None, metric: str) -> float | str:
    return "" if form is None or form.failed else form.mean(metric)
