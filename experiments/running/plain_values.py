"""Nested plain values, as a configuration has them: walked through, or flat by dotted names."""

from collections.abc import Iterator, Mapping
from typing import Any


def flat(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested mappings by their dotted names.

    Args:
        node: a mapping; lists in it are leaves, and so are empty mappings.
        name: the name of the node itself.
    """
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from flat(value, f"{name}.{key}" if name else str(key))
    else:
        yield name, node


def walk(
    path: str, node: Any, holder: Mapping[str, Any] | None = None
) -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """Yield everything within a node, the node first.

    Args:
        path: the dotted path of the node; empty for a whole configuration, which is not yielded.
        node: mappings and lists of plain values.
        holder: the mapping that holds the node.

    Yields:
        The path, the value, and the mapping that holds it; entries of a list have an empty one.
    """
    if path:
        yield path, node, holder or {}
    inner = node if isinstance(node, dict) else {}
    parts = enumerate(node) if isinstance(node, list) else inner.items()
    for key, value in parts:
        yield from walk(f"{path}.{key}" if path else str(key), value, inner)
