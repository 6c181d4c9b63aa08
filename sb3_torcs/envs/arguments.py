"""
Keyword arguments from a table: their checks, their signature and their documentation.

A table is a ``TypedDict``, from which editors and type checkers know names and types. Defaults and
checks stand in its annotations, and what an argument means in its docstring.
"""

from __future__ import annotations

import inspect
import re
import textwrap
import typing
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

from sb3_torcs.errors import InvalidOption, near_miss, unknown_argument

__all__ = ["Option", "Table", "options_of", "read_group", "read_options", "select", "takes_options"]

Environment = TypeVar("Environment", bound=type)


class Option(NamedTuple):
    """
    A keyword argument.

    :param default: its value where it is not given
    :param check: takes the argument's name and value, and returns the value to use; raises
        ``InvalidOption``. Without a check, whatever uses the argument checks it
    :param hint: its type
    :param text: what it means
    """

    default: Any
    check: Callable[[str, Any], Any] | None = None
    hint: Any = None
    text: str = ""


Table = Mapping[str, Option]


def options_of(kind: type) -> dict[str, Option]:
    """
    Read a table.

    :param kind: a ``TypedDict`` whose annotations have an :class:`Option` each
    :return: the options by name, in order
    """
    texts = re.findall(r":param (\w+): (.*?)(?=\n\s*:|\Z)", kind.__doc__ or "", re.DOTALL)
    meanings = {name: " ".join(text.split()) for name, text in texts}
    types = typing.get_type_hints(kind)
    annotated = typing.get_type_hints(kind, include_extras=True)
    return {
        name: hint.__metadata__[0]._replace(hint=types[name], text=meanings.get(name, ""))
        for name, hint in annotated.items()
    }


def read_options(owner: str, table: Table, given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Check keyword arguments.

    :param owner: whose they are, for the error
    :param table: all that it takes
    :param given: those that were passed
    :return: the values of all
    :raises TypeError: if there is no such argument
    :raises InvalidOption: if one has a value that is not allowed
    """
    for name in given:
        if name not in table:
            raise unknown_argument(owner, name, table)
    values = {name: given.get(name, option.default) for name, option in table.items()}
    return {
        name: value if (check := table[name].check) is None else check(name, value)
        for name, value in values.items()
    }


def read_group(name: str, table: Table, given: Any) -> dict[str, Any]:
    """
    Check an argument that is a mapping.

    :param name: of the argument, e.g. ``"ends"``
    :param table: the keys that it may have
    :param given: the mapping, or ``None``
    :return: the values of all keys, as they were given
    :raises InvalidOption: if it is no mapping, or has an unknown key or a wrong value
    """
    if given is None:
        given = {}
    if not isinstance(given, Mapping):
        raise InvalidOption(f"{name} is {given!r}; expected a dict with any of {', '.join(table)}")
    for key in given:
        if key not in table:
            advice = f"it may have {', '.join(table)}"
            raise InvalidOption(f"{name} has no key {key!r}{near_miss(key, table, advice)}")
    values = {key: given.get(key, option.default) for key, option in table.items()}
    for key, option in table.items():
        if option.check is not None:
            option.check(key, values[key])
    return values


def select(table: Table, values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Select the arguments of a smaller table.

    :param table: which to select
    :param values: of :func:`read_options` with a greater table
    """
    return {name: values[name] for name in table}


def takes_options(table: Table) -> Callable[[Environment], Environment]:
    """
    Give a class the signature and the documentation of its keyword arguments.

    :param table: all that its constructor takes by ``**options``
    :return: the decorator of the class
    """

    def decorate(environment: Environment) -> Environment:
        init: Any = environment.__init__  # type: ignore[misc]  # of this class, no subclass
        own = inspect.signature(init)
        first = [each for each in own.parameters.values() if each.kind is not each.VAR_KEYWORD]
        more = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=option.default, annotation=option.hint
            )
            for name, option in table.items()
        ]
        init.__signature__ = own.replace(parameters=[*first, *more])
        lines = [f":param {name}: {option.text}" for name, option in table.items()]
        wrapped = [textwrap.fill(line, 96, subsequent_indent="    ") for line in lines]
        text, raises, errors = (inspect.getdoc(environment) or "").partition(":raises")
        environment.__doc__ = "\n".join([text.rstrip(), *wrapped, raises + errors])
        return environment

    return decorate
