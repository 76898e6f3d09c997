"""`dolens apply`: the camera of a run, or any lens, on pictures of one's own."""

from pathlib import Path
from typing import Annotated, Any

import typer

from dolens.cli.extras import TRUST, import_extra, quiet_logging
from dolens.errors import InputError, readable
from dolens.files import check_written, resolved_path


def apply(
    run_or_lens: Annotated[
        str,
        typer.Argument(
            help="The folder of a run, or a lens: a file that `dolens show` reads, or the name of "
            "a lens of dolens.",
            metavar="RUN|LENS",
        ),
    ],
    pictures: Annotated[
        list[Path],
        typer.Argument(
            help="PNG, TIFF, JPEG, BMP, GIF, PPM or WebP, 8 or 16 bits.", metavar="PICTURE..."
        ),
    ],
    depth: Annotated[
        list[str] | None,
        typer.Option(
            metavar="<length>",
            help="Where the picture stands in front of the lens: mm, or as 6m, or inf of a lens; "
            "give it several times for several depths. By default the run's middle depth, or the "
            "lens's own object distance.",
        ),
    ] = None,
    light: Annotated[
        float | None,
        typer.Option(help="Of a lens: electrons of a white pixel on the axis; by default 100."),
    ] = None,
    read_noise: Annotated[
        float | None, typer.Option(help="Of a lens's sensor: electrons; by default 3.")
    ] = None,
    bayer: Annotated[
        bool, typer.Option("--bayer", help="Of a lens's sensor: colour filters RGGB.")
    ] = False,
    sensor: Annotated[
        str | None,
        typer.Option(
            metavar="<WxH>",
            help="Of a lens: width and height of its sensor, mm, as 36x24; by default the largest "
            "of the picture's shape in the image circle.",
        ),
    ] = None,
    pitch: Annotated[
        float | None,
        typer.Option(
            help="Of a lens's sensor: micrometres from pixel to pixel; by default a pixel of the "
            "picture is one of the sensor."
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(
            help="Pixels of the picture to one of the sensor, along each side. By default 1; for a "
            "run's camera of a wide field, what fills its sensor."
        ),
    ] = None,
    diffraction: Annotated[
        str | None,
        typer.Option(
            help="none, limit or wave; by default as in the run's own test images, or what shows "
            "of it."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the sensor's noise.")] = 0,
    raw: Annotated[
        bool,
        typer.Option(
            "--raw",
            help="The files are what a real sensor of a run's design gave: linear numbers in PNG, "
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
        int | None,
        typer.Option(
            help="Pixels restored at once, along each side. By default 512, and the result is the "
            "same; for a lens, what its change of blur over the field allows."
        ),
    ] = None,
    megapixels: Annotated[
        float,
        typer.Option(help="The largest picture that is read, millions of pixels."),
    ] = 64.0,
    checkpoint: Annotated[
        str | None,
        typer.Option(
            help="Whose weights, of a run: last, best, or the path of a file; by default last."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="The folder that is written to; by default RUN/applied, or LENS_applied here."
        ),
    ] = None,
    trust: Annotated[bool, typer.Option("--trust", help=TRUST)] = False,
) -> None:
    """Show what a camera makes of pictures: its sensor's image, and the restored one.

    A picture is the scene: a plane at a depth. A LENS has it all over its image circle, blurred by
    the lens as it is at each place; nothing is trained. With several depths the restorer is not
    told which of them it is.

    Of a RUN a pixel of the picture is one of the sensor, and is blurred as on the axis; a camera of
    a wide field has the picture all over its sensor instead. Noise is that of the run's readout.

    Example: dolens apply cooke_triplet picture.jpg --light 1000 --bayer
    """
    quiet_logging()
    resolved_path(run_or_lens)
    options = import_extra("dolens.experiments.commands.apply_options", "train", "dolens apply")
    shared: dict[str, Any] = {
        "depths": tuple(options.depth_of(text) for text in depth or ()),
        "scale": scale,
        "diffraction": diffraction,
        "seed": seed,
        "bits": bits,
        "format": format,
        "window": window,
        "save_raw": save_raw,
        "megapixels": megapixels,
    }
    of_runs = {
        "raw": raw or None,
        "black_level": black_level,
        "white_level": white_level,
        "checkpoint": checkpoint,
        "trust": trust or None,
    }
    of_lenses = {
        "light": light,
        "read_noise": read_noise,
        "bayer": bayer or None,
        "sensor": None if sensor is None else options.size_of(sensor),
        "pitch": pitch,
    }
    check_written(out, "--out", folder=True)
    if Path(run_or_lens).is_dir():
        _refuse(of_lenses, f"{run_or_lens} is a run, whose sensor is its own")
        module = import_extra("dolens.experiments.commands.apply", "train", "dolens apply")
        chosen = options.Options(
            raw=raw, black_level=black_level, white_level=white_level, **shared
        )
        folder, camera, found = module.apply_run(
            run_or_lens, pictures, chosen, checkpoint or "last", out, trust
        )
        typer.echo(
            f"{camera.run.experiment}, checkpoint of {camera.run.step} steps; restored in "
            f"{camera.where}"
        )
    else:
        _refuse(of_runs, f"{run_or_lens} is no run folder but a lens")
        module = import_extra("dolens.experiments.commands.apply_lens", "train", "dolens apply")
        given = {name: value for name, value in of_lenses.items() if value is not None}
        folder, found = module.apply_lens(
            run_or_lens, pictures, options.LensOptions(**shared, **given), out
        )
    _show(found)
    typer.echo(readable(folder))


def _refuse(options: dict[str, Any], reason: str) -> None:
    """Refuse the first of some options that was given."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"--{name.replace('_', '-')}: {reason}")


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
