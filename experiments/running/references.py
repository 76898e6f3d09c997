"""What parts of a configuration name by interpolations, found without resolving them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dolens.experiments.running.plain_values import walk

# `${network}`, `${data.batch_size}`: from the top, and not as the argument of a resolver's name.
_PLAIN = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}")


@dataclass(frozen=True)
class References:
    """The settings that some parts of a configuration cannot be resolved without.

    Attributes:
        wholes: dotted paths that are a value, with all that lies below them.
        within: dotted paths within a longer text, or in the arguments of a resolver.
    """

    wholes: frozenset[str]
    within: frozenset[str]

    @classmethod
    def of(cls, plain: Mapping[str, Any], parts: Sequence[str]) -> "References":
        """Return the references that begin in some parts, and go on in what they lead to.

        Those that are relative, nested, indexed or optional are not among them.

        Args:
            plain: the configuration as plain values, with its interpolations.
            parts: top-level keys.
        """
        wholes: set[str] = set()
        within: set[str] = set()
        waiting = [plain.get(key) for key in parts]
        while waiting:
            for text in _texts(waiting.pop()):
                whole = _PLAIN.fullmatch(text)
                for path in {*_PLAIN.findall(text)} - (wholes if whole else within):
                    (wholes if whole else within).add(path)
                    node = _at(plain, path)
                    # A resolver may take some of a mapping's entries only.
                    if whole or isinstance(node, str):
                        waiting.append(node)
        return cls(frozenset(wholes), frozenset(within))

    def need(self, path: str) -> bool:
        """Return whether a setting is surely needed; others may be needed by ways unseen here.

        Args:
            path: dotted, of a setting that is there.
        """
        return any(_lies_in(path, one) or _lies_in(one, path) for one in self.wholes) or any(
            _lies_in(one, path) for one in self.within
        )


def _lies_in(inner: str, outer: str) -> bool:
    return inner == outer or inner.startswith(f"{outer}.")


def _texts(node: Any) -> Iterator[str]:
    """Yield the texts in a node that may hold an interpolation; one behind a backslash is none."""
    for _, value, _ in walk(".", node):
        if isinstance(value, str) and "${" in value and "\\" not in value:
            yield value


def _at(plain: Any, path: str) -> Any:
    """Return the plain value at a path; None where another interpolation lies on the way."""
    for key in path.split("."):
        if not isinstance(plain, Mapping) or key not in plain:
            return None
        plain = plain[key]
    return plain
