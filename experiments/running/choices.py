"""A group of settings is chosen by the name of a file; what is no name is explained."""

from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from dolens.files import packaged_configuration


def no_choice(overrides: Sequence[str]) -> str | None:
    """Return what to say of the first override that chooses a group by something else than a name.

    Hydra itself stumbles over `logger=null`.

    Args:
        overrides: as they were typed; others of the command line's arguments may be among them.

    Returns:
        One line; None where there is no such override.
    """
    for text in overrides:
        try:
            (override,) = OverridesParser.create().parse_overrides([text])
        except HydraException:
            continue
        if override.is_sweep_override() or isinstance(override.value(), str | list):
            continue
        folder = packaged_configuration() / override.key_or_group
        if folder.is_dir():
            names = sorted(path.stem for path in folder.glob("*.yaml"))
            return (
                f"{text}: {override.key_or_group} is chosen by the name of a file "
                f"(there are: {', '.join(names)})"
            )
    return None
