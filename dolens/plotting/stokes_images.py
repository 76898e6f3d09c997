"""A polarised scene is shown as a sensor with analysers sees it."""

from matplotlib.figure import Figure

from dolens.plotting.style import PAGE, SMALL, draw_title
from dolens.rendering.stokes_images import ANALYSERS, StokesPhotograph, linear_polarisation
from dolens.sensor.colour import linear_to_srgb


def stokes_figure(
    photograph: StokesPhotograph, channel: int = 1, title: str | None = "Polarised light"
) -> Figure:
    """Show the light behind each analyser, and the degree of linear polarisation of the scene, of
    what the sensor measures, and what the lens alone changes of it.

    Args:
        photograph: what is shown.
        channel: the colour of the second row.
        title: above all panels.
    """
    height, width = photograph.image.shape[-2:]
    figure = Figure(figsize=(PAGE, 0.45 * PAGE * height / width + 0.9), layout="constrained")
    above, below = figure.subplots(2, 4)
    for axes in (*above, *below):
        axes.set(xticks=[], yticks=[])
    for axes, light, angle in zip(above, photograph.analysers, ANALYSERS, strict=True):
        # Behind an analyser is half of unpolarised light.
        axes.imshow(linear_to_srgb((2.0 * light).clamp(0.0, 1.0)).permute(1, 2, 0).cpu().numpy())
        axes.set_title(f"behind {angle:g}°, doubled", fontsize=SMALL)
    seen = [linear_polarisation(s) for s in (photograph.scene, photograph.measured)]
    for axes, (degree, _), name in zip(below, seen, ("scene", "measured"), strict=False):
        image = axes.imshow(degree[channel].cpu().numpy(), cmap="cividis", vmin=0.0, vmax=1.0)
        axes.set_title(f"degree, {name}", fontsize=SMALL)
    figure.colorbar(image, ax=below[1]).ax.tick_params(labelsize=SMALL - 1)
    image = below[2].imshow(seen[1][1][channel].cpu().numpy(), cmap="twilight", vmin=-90, vmax=90)
    below[2].set_title("axis, measured (°)", fontsize=SMALL)
    figure.colorbar(image, ax=below[2]).ax.tick_params(labelsize=SMALL - 1)
    error = photograph.error[channel].cpu()
    most = max(float(error.abs().max()), 1e-9)
    image = below[3].imshow(error.numpy(), cmap="RdBu_r", vmin=-most, vmax=most)
    below[3].set_title("degree, by the lens", fontsize=SMALL)
    figure.colorbar(image, ax=below[3]).ax.tick_params(labelsize=SMALL - 1)
    draw_title(figure, title)
    return figure
