"""The log of a run, `log.txt`."""

import logging
import sys


class LogFile(logging.FileHandler):
    """Writes the log of a run; a line that cannot be written, as on a full disk, ends nothing.

    The first such line is named on the error output, in one line and not in a traceback for each.
    """

    _failed = False

    def handleError(self, record: logging.LogRecord) -> None:
        """Name the failure, once."""
        if not self._failed:
            self._failed = True
            reason = sys.exc_info()[1]
            sys.stderr.write(f"warning: {self.baseFilename} cannot be written ({reason})\n")

    def close(self) -> None:
        """Close the file; what it still holds may not find room."""
        try:
            super().close()
        except OSError:
            self.handleError(logging.makeLogRecord({}))
