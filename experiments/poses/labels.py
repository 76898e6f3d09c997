"""Labels of variables in figures."""


def variable_label(name: str) -> str:
    """Return a label for people.

    `elements.lens.tilt_x` becomes `lens tilt x`, `sources.1.z` `source 1 z`, and `sources.*.z`
    `sources z`.
    """
    short = name.removeprefix("elements.").replace("sources.*.", "sources ")
    short = short.replace("sources.", "source ")
    return short.replace(".", " ").replace("_", " ")
