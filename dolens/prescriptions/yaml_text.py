"""Prescriptions as YAML: plain values, every key once, nothing that names code."""

from collections.abc import Mapping
from typing import Any

import yaml

from dolens.errors import InputError, one_line
from dolens.prescriptions.read_file import ReadPrescription

# Far more than a lens has; aliases (*name) let a short file mean billions of values.
_MOST_VALUES = 2_000_000


class _PlainLoader(yaml.SafeLoader):
    """This safe YAML loader also refuses a key written twice, as the first would be lost, and a
    file that means too many values.
    """

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _values_in(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f"it means more than {_MOST_VALUES} values")
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        scalars = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for key_node in scalars:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                line = key_node.start_mark.line + 1
                raise yaml.YAMLError(f"key '{key}' is given twice, again in line {line}")
            seen.add(key)
        return super().construct_mapping(node, deep)


def read_yaml(text: str, where: str) -> ReadPrescription:
    """Read a prescription in YAML; see `plain_values`."""
    return ReadPrescription(plain_values(text, where), [])


def plain_values(text: str, where: str) -> Any:
    """Read YAML as plain values; nothing in it names code, and no key may be given twice.

    Args:
        text: what the file holds.
        where: its name, for messages.

    Raises:
        InputError: it is not valid YAML; the message is one line.
    """
    try:
        # A subclass of the safe loader: it builds plain values only.
        return yaml.load(text, Loader=_PlainLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{where}: is not valid YAML ({one_line(error)})") from None
    except RecursionError:
        raise InputError(f"{where}: is not valid YAML (it is nested too deeply)") from None


def _values_in(node: yaml.Node, known: dict[int, int]) -> int:
    """Return how many values a node means, aliases and all; too many where it holds itself."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = _MOST_VALUES + 1  # until it is counted, for a node that holds itself
        entries = node.value if isinstance(node, yaml.SequenceNode) else sum(node.value, ())
        known[id(node)] = 1 + sum(_values_in(entry, known) for entry in entries)
    return known[id(node)]


def yaml_of(prescription: Mapping[str, Any], where: str) -> bytes:
    """Write a prescription as YAML."""
    text = yaml.safe_dump(
        prescription, sort_keys=False, default_flow_style=None, width=200, allow_unicode=True
    )
    return text.encode()
