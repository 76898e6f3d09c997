"""A reader of a lens format returns a prescription, and what the file says besides."""

from typing import Any, NamedTuple


class ReadPrescription(NamedTuple):
    """A `ReadPrescription` is the content of a lens file as plain data.

    Attributes:
        prescription: as `lens_from_prescription` takes it.
        passed_over: what the file says that bends no ray and is not held, in words, such as
            `coatings (COAT)`; nothing that changes a ray's way is among it.
    """

    prescription: Any
    passed_over: list[str]
