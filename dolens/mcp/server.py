"""The server of the Model Context Protocol.

Neither it nor its tools need PyTorch or the optics, so that it answers at once; the work is done in
a `Worker`.
"""

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from mcp.server.mcpserver import Context, MCPServer
from mcp.server.mcpserver.exceptions import ToolError
from mcp_types import CallToolResult, TextContent, ToolAnnotations
from pydantic import ValidationError

from dolens.errors import InputError, check_choice, check_keys, one_line, readable
from dolens.files import installed_version
from dolens.mcp.session import Session
from dolens.mcp.tools import TOOLS, Tools

_INSTRUCTIONS = (
    "Design lenses. Lengths are in mm, wavelengths in nm, angles in degrees; keys of numbers end "
    "in their unit. A lens of the session has a name and never changes: load, change, optimize, "
    "search and neighbours answer with the names of new ones. 'errors' says what each number errs "
    "by. A usual course: search, check, optimize, check, tolerance, export."
)


class LensServer(MCPServer):
    """The server: every refusal is one line of an answer, never a traceback.

    Args:
        folder: that files are read from and written to.
        seconds: that a call may take.

    Raises:
        InputError: there is no such folder.
    """

    def __init__(self, folder: str | Path, seconds: float = 120.0) -> None:
        self.lens_session = session = Session(folder, seconds)

        @asynccontextmanager
        async def life(_: Any) -> AsyncIterator[None]:
            session.worker.start()
            try:
                yield
            finally:
                session.worker.stop()

        super().__init__(
            "dolens",
            instructions=_INSTRUCTIONS,
            version=installed_version("dolens") or "",
            log_level="ERROR",
            lifespan=life,
            subscriptions=False,
        )
        tools = Tools(session)
        for name in TOOLS:
            method: Callable[..., Awaitable[CallToolResult]] = getattr(tools, name)
            self.add_tool(
                method,
                description=one_line(method.__doc__),
                structured_output=False,
                annotations=ToolAnnotations(
                    read_only_hint=name != "export",
                    destructive_hint=name == "export",
                    open_world_hint=False,
                ),
            )

    async def call_tool(
        self, name: str, arguments: dict[str, Any], context: Context[Any, Any] | None = None
    ) -> Any:
        """Call a tool; what is refused is an answer of one line that is marked as an error."""
        try:
            check_choice(name, TOOLS, "tool")
            tool = self._tool_manager.get_tool(name)
            assert tool is not None
            check_keys(arguments, tool.parameters["properties"], f"{name}()")
            return await super().call_tool(name, arguments, context)
        except InputError as error:
            line = str(error)
        except ToolError as error:
            line = _line(name, error.__cause__ or error)
        return CallToolResult(content=[TextContent(type="text", text=line)], is_error=True)


def _line(tool: str, cause: BaseException) -> str:
    """Return the one line that says why a call was refused."""
    if isinstance(cause, InputError):
        return str(cause)
    if isinstance(cause, ValidationError):
        first = cause.errors(include_url=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"][:2])
        given = "" if first["type"] == "missing" else f"{readable(repr(first['input']))[:80]}; "
        return str(InputError(f"{tool}: {place}: {given}{first['msg']}"))
    return f"{tool}: an error of dolens itself: {type(cause).__name__}"


def serve(folder: str | Path, seconds: float) -> None:
    """Serve over the standard input and output until the input ends.

    Args:
        folder: that files are read from and written to.
        seconds: that a call may take.

    Raises:
        InputError: there is no such folder.
    """
    LensServer(folder, seconds).run("stdio")
