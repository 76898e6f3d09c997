"""The lenses of a session by name, its folder, and the process that does the work."""

import re
from pathlib import Path
from typing import Any

from dolens.errors import InputError, did_you_mean
from dolens.mcp.answer import Answer, Prescription
from dolens.mcp.folder import Folder
from dolens.mcp.worker import Worker

MOST_LENSES = 500
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")


class Session:
    """The lenses of a session by name, its folder, and the process that does the work.

    Args:
        folder: that files are read from and written to.
        seconds: that a call may take.
    """

    def __init__(self, folder: str | Path, seconds: float) -> None:
        self.folder = Folder(folder)
        self.worker = Worker(seconds)
        self.lenses: dict[str, Prescription] = {}

    def prescription(self, lens: str) -> Prescription:
        """Return the prescription of a lens.

        Raises:
            InputError: the session has no such lens.
        """
        if lens not in self.lenses:
            near = did_you_mean(lens, self.lenses)
            raise InputError(
                f"lens: '{lens}' is none of the session{near} (it has: "
                f"{', '.join(list(self.lenses)[-20:]) or 'none; load or search one'})"
            )
        return self.lenses[lens]

    async def run(
        self, job: str, name: str | None = None, after: str = "lens", **arguments: Any
    ) -> Answer:
        """Run a job and keep the lenses that it made; see `Worker.run`.

        Args:
            job: see `Worker.run`.
            name: of the first new lens, as the user wants it.
            after: what lenses are named after that the job does not name.
            arguments: of the job.

        Returns:
            The job's `Answer`, with the names of new lenses among its values.
        """
        if name is not None and (not _NAME.fullmatch(name) or name in self.lenses):
            raise InputError(
                f"name: '{name}' is taken, or no name; allowed: 1 to 40 letters, digits, '_', '.' "
                "and '-' that no lens of the session has"
            )
        answer: Answer = await self.worker.run(job, arguments)
        if len(self.lenses) + len(answer.lenses) > MOST_LENSES:
            raise InputError(
                f"{job}: a session has {MOST_LENSES} lenses at most; export what counts, and start "
                "another"
            )
        names = []
        for wanted, prescription in answer.lenses:
            names.append(name or self._free(wanted or after))
            name = None
            self.lenses[names[-1]] = prescription
        if len(names) == 1 and "forms" not in answer.values:
            answer.values = {"lens": names[0], **answer.values}
        for form, made in zip(answer.values.get("forms", ()), names, strict=False):
            form["lens"] = made
        return answer

    def _free(self, wanted: str) -> str:
        """Return a name like the wanted one that no lens has."""
        base = re.sub(r"[^A-Za-z0-9_.-]+", "_", wanted)[:32].strip("_.-") or "lens"
        base = re.sub(r"_\d+$", "", base)
        if base not in self.lenses and not base.startswith(("search", "near")):
            return base
        number = 1 if base.startswith(("search", "near")) else 2
        while f"{base}_{number}" in self.lenses:
            number += 1
        return f"{base}_{number}"
