"""The record of a search: a journal of its trials in one file, which other processes may add to.

Optuna's journal is lines of JSON.  It needs no database, is safe on network file systems, and
nothing in it is executed.
"""

import fcntl
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial

from dolens.errors import InputError, one_line

JOURNAL = "search.journal"
_STUDY = "search"
# An attribute of the study.
_SETTINGS = "settings"


@dataclass(frozen=True)
class Record:
    """A `Record` is the journal of a search, as Optuna sees it.

    Attributes:
        study: proposes trials, and takes their results.
        storage: what the study writes to.
    """

    study: optuna.Study
    storage: JournalStorage

    def trial(self, number: int) -> tuple[int, FrozenTrial]:
        """Return the identity of a trial in the storage, and the trial as it stands."""
        study_id = self.storage.get_study_id_from_name(_STUDY)
        identity = self.storage.get_trial_id_from_study_id_trial_number(study_id, number)
        return identity, self.storage.get_trial(identity)

    def note(self, number: int, name: str, value: Any) -> None:
        """Keep a plain value with a trial that is not finished."""
        self.storage.set_trial_user_attr(self.trial(number)[0], name, value)


def open_record(journal: Path, directions: Sequence[str], settings: Mapping[str, Any]) -> Record:
    """Open the record of a search, or begin one.

    Args:
        journal: its file.
        directions: `maximize` or `minimize`, one for each objective.
        settings: plain values that must be the same when a search goes on.

    Raises:
        InputError: the file is no such record, or that of a search with other settings.
    """
    _cut_torn_line(journal)
    # As JSON has them: a tuple comes back as a list.
    asked = json.loads(json.dumps({**settings, "directions": list(directions)}))
    try:
        storage = _storage(journal)
        study = optuna.create_study(
            storage=storage,
            study_name=_STUDY,
            directions=list(directions),
            load_if_exists=True,
        )
        known = study.user_attrs.get(_SETTINGS)
    except OSError:
        raise
    except Exception as error:
        # Whatever a broken file leads to within Optuna, it is the file that is wrong.
        raise InputError(f"{journal} is no record of a search: {one_line(error)}") from error
    if known is None:
        study.set_user_attr(_SETTINGS, asked)
    elif known != asked:
        part = next(key for key in asked if asked[key] != known.get(key))
        raise InputError(
            f"{journal.parent} holds a search with other {part}: {_short(known.get(part))}, not "
            f"{_short(asked[part])}; repeat its command, or give another hydra.sweep.dir"
        )
    return Record(study, storage)


def record_of_job(journal: Path) -> Record:
    """Return the record of a search for the process of a job."""
    storage = _storage(journal)
    return Record(optuna.load_study(storage=storage, study_name=_STUDY), storage)


@contextmanager
def alone(journal: Path) -> Iterator[None]:
    """Hold a search for one command; a process that dies lets it go.

    Raises:
        InputError: another command searches there now.
    """
    with journal.with_suffix(".held").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{journal.parent}: another command is searching there") from None
        except OSError as error:
            # Some network file systems have no such locks.
            logging.getLogger(__name__).warning(
                "%s: nothing keeps a second command out (%s)", journal.parent, error
            )
        yield


def _storage(journal: Path) -> JournalStorage:
    return JournalStorage(JournalFileBackend(str(journal)))


def _cut_torn_line(journal: Path) -> None:
    """Take away a last line without an end, as a full disk leaves it; it holds no whole entry."""
    if not journal.is_file():
        return
    with journal.open("rb+") as file:
        content = file.read()
        if content and not content.endswith(b"\n"):
            file.truncate(content.rfind(b"\n") + 1)


def _short(value: Any) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= 200 else f"{text[:199]}…"
