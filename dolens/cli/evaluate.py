"""`dolens evaluate`: the camera of a run again, on other photographs, depths or noise."""

import sys
from collections.abc import Mapping
from typing import Annotated

import typer

from dolens.cli.extras import TRUST, import_extra, quiet_logging
from dolens.errors import readable

_HEADLINES = {
    "psnr_db": "PSNR, dB",
    "ssim": "SSIM",
    "raw_psnr_db": "raw PSNR, dB",
    "raw_ssim": "raw SSIM",
}


def evaluate(
    run: Annotated[str, typer.Argument(help="The folder of the run.", metavar="RUN")],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(
            help="What is different, as Hydra has it: data=package_photographs, "
            "'scene.depths=[5000]', light=50, readout=bayer_12bit, evaluation_renderer=wave.",
            metavar="[KEY=VALUE]...",
        ),
    ] = None,
    checkpoint: Annotated[
        str, typer.Option(help="Whose weights: last, best, or the path of a file.")
    ] = "last",
    name: Annotated[
        str | None, typer.Option(help="Of the folder RUN/evaluation/NAME; by default the time.")
    ] = None,
    perturb_lens: Annotated[
        bool,
        typer.Option(
            "--perturb-lens",
            help="Let overrides set parameters of the lens that were not trained to other values, "
            "as for a lens that was made a little differently.",
        ),
    ] = False,
    trust: Annotated[bool, typer.Option("--trust", help=TRUST)] = False,
) -> None:
    """Test the camera of a RUN again, without training, and write RUN/evaluation/NAME.

    Without overrides, the numbers are those of the run's own test. What would make another camera
    (network.*, variables.*) is refused. A network that deconvolves is given the point spread
    functions of the lens as it is evaluated, at the depths of the run.
    """
    quiet_logging()
    module = import_extra("dolens.experiments.commands.evaluate", "train", "dolens evaluate")
    found = module.evaluate(run, overrides or [], checkpoint, name, perturb_lens, sys.argv, trust)
    _show(
        f"{found.run.experiment}, {found.run.step} steps", module.own_metrics(found), found.metrics
    )
    typer.echo(readable(found.folder))


def _show(title: str, own: Mapping[str, float], metrics: Mapping[str, float]) -> None:
    """Print the metrics of the test; in parentheses, by how much the run's own ones differ."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title), caption="in parentheses: difference to the run's own test")
    places = {name: _judge_and_view(name) for name in metrics}
    rows = {name: place for name, place in places.items() if place is not None}
    if rows:
        table.add_column("view")
        for headline in _HEADLINES.values():
            table.add_column(headline, justify="right")
        for judge, view in dict.fromkeys((judge, view) for judge, _, view in rows.values()):
            names = [f"{judge}/{key}{view and '/' + view}" for key in _HEADLINES]
            label = f"{judge.removeprefix('test').strip('_')} {view or 'all'}".strip()
            table.add_row(label, *(_cell(name, own, metrics) for name in names))
    else:
        table.add_column("metric", overflow="fold")
        table.add_column("value", justify="right")
        for name in metrics:
            if not name.startswith("cost/"):
                table.add_row(name, _cell(name, own, metrics))
    Console().print(table)


def _judge_and_view(name: str) -> tuple[str, str, str] | None:
    """Return `test` or `test_<judge>`, the score and the view of a metric; None for others."""
    judge, _, rest = name.partition("/")
    score, _, view = rest.partition("/")
    return (judge, score, view) if judge.startswith("test") and score in _HEADLINES else None


def _cell(name: str, own: Mapping[str, float], metrics: Mapping[str, float]) -> str:
    if name not in metrics:
        return ""
    digits = 3 if "ssim" in name else 2 if "psnr" in name else 4
    text = f"{metrics[name]:.{digits}f}" if digits < 4 else f"{metrics[name]:.4g}"
    if name not in own:
        return text
    difference = metrics[name] - own[name]
    return f"{text} ({f'{difference:+.{digits}f}' if difference else '0'})".replace("-", "−")
