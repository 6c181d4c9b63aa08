"""YAML as data: no objects, and nothing so large, so deep or so entangled that reading it hangs."""

from __future__ import annotations

import itertools
from typing import Any

import yaml

__all__ = ["read_yaml"]

MAX_LENGTH = 2**16  # [characters] a second of reading
MAX_BRACKETS = 100  # that are open at once: PyYAML takes their number squared
MAX_NODES = 100_000  # with each alias written out


def read_yaml(text: str, loader_class: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """
    Read one document.

    :param text: of the file
    :param loader_class: that builds the values
    :return: of plain Python types
    :raises yaml.YAMLError: if it is none, or too much
    """
    if len(text) > MAX_LENGTH:
        raise yaml.YAMLError(f"{len(text)} characters; at most {MAX_LENGTH} are read")
    steps = ((char in "[{") - (char in "]}") for char in text)
    if max(itertools.accumulate(steps), default=0) > MAX_BRACKETS:
        raise yaml.YAMLError("it nests too deep")
    loader = loader_class(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _written_out(node, {}) > MAX_NODES:
            raise yaml.YAMLError(f"its aliases stand for more than {MAX_NODES} values")
        return loader.construct_document(node)
    except RecursionError as error:
        raise yaml.YAMLError("it nests too deep, or an alias is within what it stands for") from (
            error
        )
    except ValueError as error:  # of a date or a number that is none
        raise yaml.YAMLError(str(error)) from error
    finally:
        loader.dispose()


def _written_out(node: yaml.Node, known: dict[int, int]) -> int:
    """Count the nodes below one as if there were no aliases; each is visited once."""
    if id(node) not in known:
        parts = node.value if isinstance(node, yaml.CollectionNode) else []
        children = [child for part in parts for child in (part if type(part) is tuple else (part,))]
        known[id(node)] = 1 + sum(_written_out(child, known) for child in children)
    return known[id(node)]
