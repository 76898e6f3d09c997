"""Names of very many files are kept in one array."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

# As names of files that are no UTF-8 reach Python.
_ENCODING = ("utf-8", "surrogateescape")


class PackedNames(Sequence[str]):
    """`PackedNames` holds names in one array of bytes.

    A million strings are a million objects, whose counts of references every look at them changes:
    in worker processes, which share memory until it is written to, a list of them grows.  An array
    does not.

    Args:
        text: the names as UTF-8, uint8, each followed by a byte of 0.
    """

    def __init__(self, text: np.ndarray) -> None:
        self.text = text
        self._ends = np.flatnonzero(text == 0)

    @classmethod
    def of(cls, names: Sequence[str]) -> "PackedNames":
        """Pack names, none of which holds a character of code 0."""
        text = "".join(f"{name}\0" for name in names).encode(*_ENCODING)
        return cls(np.frombuffer(text, dtype=np.uint8))

    def __len__(self) -> int:
        return len(self._ends)

    def __getitem__(self, number: int) -> str:  # type: ignore[override]
        """Return a name."""
        begin = 0 if number == 0 else int(self._ends[number - 1]) + 1
        return self.text[begin : int(self._ends[number])].tobytes().decode(*_ENCODING)

    def __iter__(self) -> Iterator[str]:
        """Yield all names, faster than one by one."""
        return iter(self.text.tobytes().decode(*_ENCODING).split("\0")[:-1])

    def encoded(self, numbers: Iterable[int]) -> Iterator[bytes]:
        """Yield some names as UTF-8."""
        text, ends = self.text.tobytes(), self._ends.tolist()
        for number in numbers:
            yield text[ends[number - 1] + 1 if number else 0 : ends[number]]
