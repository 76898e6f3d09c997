"""What the commands share that serve a page on this machine."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from dolens.live.serve import LocalServer

Port = Annotated[
    int | None, typer.Option(help="Of this machine, to serve the page at; by default a free one.")
]
Open = Annotated[bool, typer.Option("--open", help="Open the page in the browser.")]


def serve_until_ctrl_c(server: "LocalServer", what: str, in_browser: bool) -> None:
    """Print the address of a page, and serve it until Ctrl-C.

    Args:
        server: of the page.
        what: is shown there, for the terminal.
        in_browser: whether to open the page too.
    """
    import webbrowser

    from rich.console import Console

    from dolens.errors import readable

    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{readable(what)}, on this machine only; Ctrl-C ends it:", markup=False)
    console.print(server.address, style="bold cyan", markup=False)
    if in_browser:
        webbrowser.open(server.address)
    server.run()
    console.print("ended", markup=False)
