"""Which callbacks there are, and what environments can do for them."""

from __future__ import annotations

from collections.abc import Iterator

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_torcs.errors import InvalidOption

__all__ = ["callbacks_in", "require_method"]


def callbacks_in(callback: BaseCallback | None) -> Iterator[BaseCallback]:
    """
    Walk a tree of callbacks.

    :param callback: its root: a list, an event with children, or a single one
    :return: the root and everything below it
    """
    if callback is None:
        return
    yield callback
    children = [*getattr(callback, "callbacks", ())]
    children += [getattr(callback, name, None) for name in ("callback", "callback_on_new_best")]
    for child in children:
        if isinstance(child, BaseCallback):
            yield from callbacks_in(child)


def require_method(env: VecEnv, name: str) -> None:
    """
    Make sure that environments have a method. A worker process would end with an error.

    :param env: of the training
    :param name: of the method
    :raises InvalidOption: if they lack it
    """
    if not env.has_attr(name):
        raise InvalidOption(
            f"the environment has no {name}; use Torcs-v0, TorcsLite-v0 or another RacingEnv of "
            "sb3_torcs"
        )
