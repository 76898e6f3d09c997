"""`dolens apply`: the camera of a run on pictures of one's own."""

from pathlib import Path
from typing import Annotated

import typer

from dolens.cli.extras import TRUST, import_extra
from dolens.cli.quiet_logging import quiet_logging
from dolens.errors import readable
from dolens.file_text import check_written


def apply(
    run: Annotated[str, typer.Argument(help="The folder of the run.", metavar="RUN")],
    pictures: Annotated[
        list[Path],
        typer.Argument(
            help="PNG, TIFF, JPEG, BMP, GIF, PPM or WebP, 8 or 16 bits.", metavar="PICTURE..."
        ),
    ],
    depth: Annotated[
        list[float] | None,
        typer.Option(
            help="Where the picture stands, mm in front of the lens; give it several times for "
            "several depths. By default the run's middle depth."
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(
            help="Pixels of the picture to one of the sensor, along each side. By default 1; for a "
            "camera of a wide field, what fills its sensor."
        ),
    ] = None,
    diffraction: Annotated[
        str | None,
        typer.Option(help="none, limit or wave; by default as in the run's own test images."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the sensor's noise.")] = 0,
    raw: Annotated[
        bool,
        typer.Option(
            "--raw",
            help="The files are what a real sensor of this design gave: linear numbers in PNG, "
            "TIFF or .npy, with colour filters where the run's readout has them. They are restored "
            "only.",
        ),
    ] = False,
    black_level: Annotated[
        float | None, typer.Option(help="Of --raw: the number without light.")
    ] = None,
    white_level: Annotated[
        float | None, typer.Option(help="Of --raw: the number at full scale.")
    ] = None,
    bits: Annotated[int, typer.Option(help="Of what is written: 8 or 16.")] = 8,
    format: Annotated[str, typer.Option(help="Of what is written: png or tif.")] = "png",
    save_raw: Annotated[
        bool,
        typer.Option("--save-raw", help="Write the simulated sensor's raw numbers too, as .npy."),
    ] = False,
    window: Annotated[
        int,
        typer.Option(help="Pixels restored at once, along each side; the result is the same."),
    ] = 512,
    megapixels: Annotated[
        float,
        typer.Option(help="The largest picture that is read, millions of pixels."),
    ] = 64.0,
    checkpoint: Annotated[
        str, typer.Option(help="Whose weights: last, best, or the path of a file.")
    ] = "last",
    out: Annotated[
        Path | None, typer.Option(help="The folder that is written to; by default RUN/applied.")
    ] = None,
    trust: Annotated[bool, typer.Option("--trust", help=TRUST)] = False,
) -> None:
    """Show what the camera of a RUN makes of pictures: its sensor's image, and the restored one.

    A picture is the scene: a plane at a depth. A pixel of it is one of the sensor, and is blurred
    as on the axis; a camera of a wide field has the picture all over its sensor instead, blurred
    by the lens as it is at each place. Noise is that of the run's readout.
    """
    quiet_logging()
    module = import_extra("dolens.experiments.commands.apply", "train", "dolens apply")
    options = module.Options(
        depths=tuple(depth or ()),
        scale=scale,
        diffraction=diffraction,
        seed=seed,
        bits=bits,
        format=format,
        window=window,
        save_raw=save_raw,
        raw=raw,
        black_level=black_level,
        white_level=white_level,
        megapixels=megapixels,
    )
    check_written(out, "--out", folder=True)
    folder, camera, found = module.apply_run(run, pictures, options, checkpoint, out, trust)
    where = "whole pictures" if camera.margin is None else f"windows of {window} pixels"
    beside = "" if camera.margin is None else f" and {camera.margin} around them"
    typer.echo(
        f"{camera.run.experiment}, checkpoint of {camera.run.step} steps; restored in "
        f"{where}{beside}"
    )
    _show(found)
    typer.echo(readable(folder))


def _show(found: list) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    for mapping in dict.fromkeys(entry.mapping for entry in found):
        typer.echo(mapping)
    measured = [entry for entry in found if entry.metrics]
    if not measured:
        return
    table = Table()
    table.add_column("picture", overflow="fold")
    for name in ("depth, m", "sensor PSNR, dB", "SSIM", "restored PSNR, dB", "SSIM"):
        table.add_column(name, justify="right")
    for entry in measured:
        numbers = entry.metrics
        table.add_row(
            Text(readable(entry.name)),
            f"{numbers['depth_mm'] / 1000:g}",
            f"{numbers['raw_psnr_db']:.2f}",
            f"{numbers['raw_ssim']:.3f}",
            f"{numbers['psnr_db']:.2f}",
            f"{numbers['ssim']:.3f}",
        )
    Console().print(table)
