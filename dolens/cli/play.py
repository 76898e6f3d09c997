"""The command `dolens play`."""

from pathlib import Path
from typing import Annotated

import typer

from dolens.cli.local_page import Open, Port, serve_until_ctrl_c
from dolens.cli.show import LensFile


def play(
    lens: LensFile,
    picture: Annotated[
        Path | None, typer.Option(help="A picture to photograph through the lens.")
    ] = None,
    state: Annotated[
        str | None,
        typer.Option(
            metavar="<name>", help="Of a lens that zooms or focuses; it is then a lens of its own."
        ),
    ] = None,
    port: Port = None,
    in_browser: Open = False,
) -> None:
    """Change a lens by sliders in the browser, and see section, spots, MTF and a photograph follow.

    The page is served to this machine alone, at an address that holds a secret. Nothing is written
    but by "Save".

    Example: dolens play cooke_triplet
    """
    from dolens.cli.extras import import_extra
    from dolens.prescriptions import find_lens, load_lens

    serve = import_extra("dolens.live.serve", "live", "dolens play")
    from dolens.live.play import PlayedLens
    from dolens.live.play_page import PlayPage

    path = find_lens(lens)
    played = PlayedLens(load_lens(path).in_state(state), path.stem)
    server = serve.LocalServer(PlayPage(played, picture).routes(), port)
    serve_until_ctrl_c(server, f"{played.seen.lens.name or path.stem} to play with", in_browser)
