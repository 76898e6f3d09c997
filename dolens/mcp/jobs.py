"""Jobs of the server: lenses and files; design and analyses have modules of their own.

Every job takes plain values, since it runs in a process of its own, and returns an `Answer`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import torch

from dolens.errors import InputError
from dolens.files import packaged_configuration
from dolens.mcp.analyses import analyse, show, trace
from dolens.mcp.answer import Answer, Prescription, plain
from dolens.mcp.design import check, neighbours, optimize, search, tolerance
from dolens.mcp.pictures import lens_of, png_of_sensor
from dolens.prescriptions import (
    lens_from_prescription,
    lens_names,
    prescription_of,
    published_lens_names,
)
from dolens.prescriptions.conversion import converted
from dolens.prescriptions.files import load_prescription
from dolens.prescriptions.lens_formats import read_lens

Job = Callable[..., Answer]


def of_dolens() -> Answer:
    """Name the lenses that come with dolens."""
    return Answer({"of_dolens": [*lens_names(), *published_lens_names()]})


def load(source: str, data: bytes | None, picture: bool) -> Answer:
    """Read a lens: the content of a file, or a lens of dolens by its name.

    Args:
        source: the file's name or text's, or that of a lens of dolens.
        data: what the file holds; None for a lens of dolens.
        picture: whether one is wanted.

    Raises:
        InputError: it is no lens.
    """
    if data is None:
        known = [*lens_names(), *published_lens_names()]
        if source not in known:
            raise InputError(
                f"load: '{source}' is no lens of dolens, and a file's name has a suffix; allowed: "
                f"{', '.join(lens_names())}, or published/… of the tool 'lenses'"
            )
        # Whatever the folder is that the server was started in.
        path = packaged_configuration() / "lens" / f"{source}.yaml"
        prescription, passed = load_prescription(path), []
    else:
        read = read_lens(data, source)
        prescription, passed = read.prescription, list(read.passed_over)
    lens: Any = lens_from_prescription(prescription, where=source)
    answer = show(prescription_of(lens), picture)
    answer.notes += [f"passed over: {text}" for text in passed]
    stem = source.rpartition("/")[2].partition(".")[0]
    answer.add(lens, stem)
    return answer


def change(prescription: Prescription, changes: dict[str, Any], picture: bool) -> Answer:
    """Change values of a prescription.

    Args:
        prescription: of the lens.
        changes: path → value, as `surfaces.1.radius` → 21.
        picture: whether one is wanted.

    Raises:
        InputError: a path that leads nowhere, or what is no lens.
    """
    wanted = copy.deepcopy(dict(prescription))
    for path, value in changes.items():
        *parts, last = path.split(".")
        place: Any = wanted
        for part in parts:
            if not isinstance(place, dict) or part not in place:
                keys = ", ".join(map(str, place)) if isinstance(place, dict) else "no key"
                raise InputError(f"change: '{path}': no '{part}' (allowed: {keys})")
            place = place[part]
        if not isinstance(place, dict):
            raise InputError(f"change: '{path}' leads into a value, and not into a table")
        if last in ("radius", "curvature"):
            place.pop("curvature" if last == "radius" else "radius", None)
        place[last] = value
    lens = lens_from_prescription(wanted, where="change")
    answer = show(prescription_of(lens), picture)
    answer.add(lens)
    return answer


def export(prescription: Prescription, file: str, picture: bool) -> Answer:
    """Write a lens as a file of the format that the name's suffix says, and read it again.

    Raises:
        InputError: the format cannot hold the lens.
    """
    found = converted(prescription, "the lens", file)
    answer = Answer({"bytes": len(found.data), "changes": list(found.changes)}, file=found.data)
    waves = found.before.wavelengths or (587.5618,)
    error = max(
        abs(float(one.index(wave)) - float(other.index(wave)))
        for one, other in zip(found.before.materials, found.after.materials, strict=True)
        for wave in waves
    )
    how = "the file was read again; every other number is the same to the last bit"
    if not found.same_numbers and error == 0.0:
        how = "the file was read again; see changes"
    answer.errs("refractive indices", error, "", how)
    after: Any = found.after
    answer.show(after.draw() if picture else None, picture)
    return answer


def photograph(
    prescription: Prescription,
    data: bytes | None,
    file: str | None,
    distance: float | None,
    light: float | None,
    picture: bool,
) -> Answer:
    """Photograph a picture through a lens.

    Args:
        prescription: of the lens.
        data: of a picture's file; None: a chart of stripes that is drawn here.
        file: its name.
        distance: see `Lens.photograph`.
        light: likewise.
        picture: whether one is wanted.
    """
    lens = lens_of(prescription)
    found = lens.photograph(_pixels(data, file), distance, light)
    size = found.image.shape[-2:]
    error = (found.image - found.truth).square().mean()
    psnr = float(-10.0 * torch.log10(error))
    answer = Answer(
        plain(
            {
                "rows": size[0],
                "columns": size[1],
                "psnr_db": psnr,
                "distance_mm": found.distance,
                "camera": found.camera.description,
            }
        )
    )
    answer.errs(
        "the image",
        None,
        "",
        "blur is interpolated between field points; against an image traced ray by ray see "
        "docs/renderers.md; psnr_db compares with the picture without blur and noise",
    )
    if picture:
        answer.picture = png_of_sensor(found.image)
    return answer


def _pixels(data: bytes | None, file: str | None) -> Any:
    """Return the pixels of a picture's file, or of a chart, as `Lens.photograph` takes them."""
    import io

    import numpy as np
    from PIL import Image

    if data is None:
        y, x = np.mgrid[0:240, 0:320] / 40.0
        return (0.5 + 0.4 * np.sign(np.sin(2.0 * math.pi * x * (1.0 + x)) * np.cos(math.pi * y)))[
            ..., None
        ].repeat(3, -1)
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "BMP")) as image:
            if image.width * image.height > 20_000_000:
                raise InputError(f"{file}: more than 20 million pixels")
            found = image.convert("RGB")
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{file}: is no picture that can be read ({error})") from None
    found.thumbnail((512, 512))
    return np.asarray(found)


JOBS: dict[str, Job] = {
    job.__name__: job
    for job in (
        *(
            of_dolens,
            load,
            change,
            export,
            photograph,
            optimize,
            search,
            neighbours,
            check,
            tolerance,
        ),
        *(show, trace, analyse),
    )
}
