"""The command line's parser, which suggests the word that was probably meant."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

from sb3_torcs.errors import near_miss

__all__ = ["Parser", "grouped"]


class Parser(argparse.ArgumentParser):
    """Suggests near misses of verbs and options; options may stand between names."""

    _between = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """
        :param args: words of the command line
        :param namespace: to be filled
        :return: the namespace, and no words: what is unknown is an error
        """
        if self._between:  # argparse's own way calls this again
            return super().parse_known_args(args, namespace)
        self._between = True
        # A verb takes the rest of the words, and behind "--" all words are names.
        plain = self._subparsers is not None or "--" in (args or ())
        parse = super().parse_known_args if plain else self.parse_known_intermixed_args
        try:
            found, words = parse(args, namespace)
        finally:
            self._between = False
        unknown = [word for word in words if word != "--"]
        if unknown:
            self._refuse(unknown)
        return found, unknown

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """Refuse ``--`` as the value of an option, which argparse drops."""
        if action.option_strings and "--" in arg_strings and action.nargs != 0:
            self.error(f"argument {'/'.join(action.option_strings)}: '--' is no value; give one")
        return super()._get_values(action, arg_strings)

    def check_verb(self, word: str, verbs: Iterable[str]) -> None:
        """
        Make sure that a verb exists.

        :param word: the first of the command line
        :param verbs: those that exist
        """
        known = list(verbs)
        if not word.startswith("-") and word not in known:
            hint = near_miss(word, known, "`sb3-torcs --help` lists them")
            self.error(f"there is no verb '{word}'{hint}")

    def _refuse(self, unknown: list[str]) -> NoReturn:
        """Refuse unknown words, and suggest a near miss for the first option among them."""
        options = [option for action in self._actions for option in action.option_strings]
        wrong = next((word for word in unknown if word.startswith("-")), unknown[0])
        hint = near_miss(wrong.partition("=")[0], options)
        self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")


def grouped(groups: Mapping[str, Mapping[str, str]]) -> str:
    """
    Lay out verbs in groups, for the help.

    :param groups: of each verb its help, by group and name
    """
    width = max(len(verb) for verbs in groups.values() for verb in verbs)
    return "\n\n".join(
        "\n".join([f"{group}:", *(f"  {verb:{width}}  {text}" for verb, text in verbs.items())])
        for group, verbs in groups.items()
    )
