"""Labels of variables and images in figures."""

from collections.abc import Sequence

from dolens.plotting.style import number_text


def variable_label(name: str) -> str:
    """Return a label for people.

    `elements.lens.tilt_x` becomes `lens tilt x`, `sources.1.z` `source 1 z`, and `sources.*.z`
    `sources z`.
    """
    short = name.removeprefix("elements.").replace("sources.*.", "sources ")
    short = short.replace("sources.", "source ")
    return short.replace(".", " ").replace("_", " ")


def image_labels(sources: int, planes: Sequence[float]) -> list[str]:
    """Return the source and the plane (mm) of each image, as far as there are several.

    The images of a source on all planes follow one another, as `Pose.images` gives them.
    """
    return [
        (f", source {source + 1}" if sources > 1 else "")
        + (f"\nplane {number_text(plane)} mm" if len(planes) > 1 else "")
        for source in range(sources)
        for plane in planes
    ]
