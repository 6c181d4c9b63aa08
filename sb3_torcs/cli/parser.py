"""The command line's parser, which suggests the word that was probably meant."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Any, NoReturn

from sb3_torcs.errors import near_miss

__all__ = ["Parser"]


class Parser(argparse.ArgumentParser):
    """Suggests near misses of verbs and options; shows the verb's usage for an unknown option."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """
        :param args: words of the command line
        :param namespace: to be filled
        :return: the namespace, and no words: what is unknown is an error
        """
        found, words = super().parse_known_args(args, namespace)
        unknown = [word for word in words if word != "--"]
        if unknown:
            self._refuse(unknown)
        return found, unknown

    def check_verb(self, word: str, verbs: Iterable[str]) -> None:
        """
        Make sure that a verb exists.

        :param word: the first of the command line
        :param verbs: those that exist
        """
        known = list(verbs)
        if not word.startswith("-") and word not in known:
            hint = near_miss(word, known, f"choose from {', '.join(known)}")
            self.error(f"there is no verb '{word}'{hint}")

    def _refuse(self, unknown: list[str]) -> NoReturn:
        """Refuse unknown words, and suggest a near miss for the first option among them."""
        options = [option for action in self._actions for option in action.option_strings]
        wrong = next((word for word in unknown if word.startswith("-")), unknown[0])
        hint = near_miss(wrong.partition("=")[0], options)
        self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
