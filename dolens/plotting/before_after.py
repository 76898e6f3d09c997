"""Two layouts compare a lens before and after a change."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure

from dolens.optics.lens import Lens
from dolens.plotting.drawing import draw_layout, layout_drawing
from dolens.plotting.layout import WIDTH, drawn_height, layout_title
from dolens.plotting.titles import draw_axes_title


@torch.no_grad()
def before_after_figure(
    before: Lens,
    after: Lens,
    wavelength: float | Sequence[float] = 587.5618,
    fields_deg: Sequence[float] = (0.0,),
    rays: int = 7,
    object_distance: float | None = None,
    titles: tuple[str, str] | None = None,
) -> Figure:
    """Draw two layouts one above the other, at one scale and with their first vertices aligned.

    Args:
        before: drawn above.
        after: drawn below.
        wavelength: nm, as for `layout_figure`.
        fields_deg: degrees, as for `layout_figure`.
        rays: a field.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        titles: of the two; None for `initial` and `final` with names, focal lengths and F-numbers.

    Raises:
        InputError: as `layout_figure` does.
    """
    lenses = (before, after)
    drawings = [
        layout_drawing(lens, wavelength, fields_deg, rays, object_distance) for lens in lenses
    ]
    z_limits = (
        min(drawing.z_limits[0] for drawing in drawings),
        max(drawing.z_limits[1] for drawing in drawings),
    )
    half_height = max(drawing.half_height for drawing in drawings)
    legend = any(drawing.needs_legend for drawing in drawings)
    height = min(drawn_height(z_limits, half_height, legend), 3.6)
    # The upper drawing has no numbers below.  Were there height to spare, constrained layout would
    # widen axes of equal scales until their labels leave the figure.
    figure = Figure(figsize=(WIDTH, 2.0 * height - 0.5), layout="constrained")
    grid = figure.subplots(2, 1, sharex=True, sharey=True)
    for number, (axes, lens, drawing) in enumerate(zip(grid, lenses, drawings, strict=True)):
        draw_layout(axes, drawing, z_limits, half_height, legend=number == 0)
        if titles is None:
            line = drawing.fans[0].wavelength
            stage = ("initial", "final")[number]
            name = layout_title(lens, drawing.system, line, object_distance, stage)
            title = f"({'ab'[number]}) {name}"
        else:
            title = titles[number]
        draw_axes_title(axes, title)
    grid[0].set_xlabel("")
    return figure
