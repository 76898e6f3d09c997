"""Draw a design as it goes: the camera lens of experiment=nikon, from spheres, as animated WebP.

    python scripts/design_animation.py nikon_design.webp

Sections and spots of the frames are those of iterations that are spread evenly over the logarithm
of their number; a still of the last frame is written beside the film, for readers who want none.
"""

import argparse
import copy
import io
from collections.abc import Iterator
from pathlib import Path

import torch
import yaml
from matplotlib.figure import Figure
from PIL import Image

import dolens
from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import SpotDiagram, spot_diagram
from dolens.files import packaged_configuration
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritSettings
from dolens.plotting.layout import draw_layout, layout_drawing

FRAMES, LAST = 36, 60
COLOURS = ("#440154", "#31688e", "#35b779", "#90d743")


def designs() -> Iterator[tuple[int, dolens.Lens]]:
    """Go through the design: the number of each iteration, and the lens then."""
    file = packaged_configuration() / "experiment/nikon.yaml"
    settings = yaml.safe_load(file.read_text(encoding="utf-8"))
    lens = dolens.load_lens("nikon", index_model=settings["lens"]["index_model"])
    with torch.no_grad():
        for pattern, value in settings["start"].items():
            for parameter in lens.variables([pattern]).values():
                parameter.fill_(value)
    variables = DesignVariables(lens, settings["variables"])
    merit = MeritSettings(**settings["merit"]).build(lens, variables)
    optimizer = DampedLeastSquares([variables.parameter_group()])
    for iteration in range(LAST + 1):
        if iteration:
            optimizer.step(merit)
        now = copy.deepcopy(lens)
        merit().write_to(now)
        yield iteration, now


@torch.no_grad()
def frame(
    iteration: int, lens: dolens.Lens, spots: SpotDiagram, course: list[float]
) -> Image.Image:
    """Draw a frame: the section above, spots and course below."""
    figure = Figure(figsize=(9.0, 4.5), dpi=100)
    section = figure.add_axes((0.01, 0.36, 0.98, 0.62))
    fields = spots.fields[:, 1].tolist()
    drawing = layout_drawing(lens, lens.primary_wavelength, fields, 7, None, None)
    draw_layout(section, drawing, drawing.z_limits, 1.25)
    if section.get_legend():
        section.get_legend().remove()
    section.axis("off")
    for number, field in enumerate(fields):
        axes = figure.add_axes((0.02 + 0.155 * number, 0.03, 0.14, 0.27))
        for wavelength in range(spots.rms.shape[1]):
            spot = spots.intercepts[number, wavelength] - spots.centroid[number, wavelength]
            points = 1e3 * spot[spots.valid[number, wavelength]]
            axes.plot(points[:, 0], points[:, 1], ".", ms=1.6, color=COLOURS[number])
        axes.set(xlim=(-60, 60), ylim=(-60, 60), xticks=[], yticks=[], aspect="equal")
        radius = 1e3 * spots.rms[number].mean().item()
        axes.set_title(f"{field:g}°: {radius:.2g} µm", fontsize=9, pad=3)
    axes = figure.add_axes((0.71, 0.08, 0.27, 0.22))
    axes.semilogy(course, color="#b5482a")
    axes.plot(len(course) - 1, course[-1], "o", ms=5, color="#b5482a")
    axes.set(xlim=(0, LAST), ylim=(0.1, 60), xlabel=None)
    axes.tick_params(labelsize=7)
    axes.set_title(f"iteration {iteration}: mean RMS spot {course[-1]:.2f} µm", fontsize=9, pad=3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")


def main() -> None:
    """Design, draw and write."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("film", type=Path, help="a .webp file")
    film = parser.parse_args().film
    chosen = {round((LAST + 1) ** (n / (FRAMES - 1)) - 1) for n in range(FRAMES)}
    frames, course = [], []
    for iteration, lens in designs():
        spots = spot_diagram(lens, conditions(lens), 400)
        course.append(1e3 * spots.rms.mean().item())
        if iteration in chosen:
            frames.append(frame(iteration, lens, spots, course))
    times = [1200, *(max(150, 700 - 90 * n) for n in range(len(frames) - 2)), 3000]
    options = {"quality": 60, "method": 6}
    frames[0].save(film, save_all=True, append_images=frames[1:], duration=times, loop=0, **options)
    still = film.with_stem(f"{film.stem}_last")
    frames[-1].save(still, quality=80, method=6)
    print(f"{len(frames)} frames, {film.stat().st_size // 1000} kB: {film} and {still}")


if __name__ == "__main__":
    main()
