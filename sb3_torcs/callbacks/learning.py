"""The one callback that updates faster, and the base of those that change how a model learns."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, cast

from stable_baselines3 import PPO, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies import ppo, updates
from sb3_torcs.policies.ppo import LeanForward, LeanPPO
from sb3_torcs.policies.split_head import SplitHeadPolicy
from sb3_torcs.policies.updates import LeanUpdates

__all__ = ["LeanUpdatesCallback", "WhileLearning", "end_changes"]

REPLACED = ("train", "_excluded_save_params")  # methods of a model, between rollout and update


class _Training:
    """
    Replaces a model's ``train`` for one call, in which callbacks change the algorithm.

    Between the rollout and the call other callbacks may save the model, or Ctrl-C may end the
    training. So saved files leave the replacement out. A ``train`` that somebody else has given to
    the model learns as before.

    :param model: that has just made a rollout
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self.callbacks: list[WhileLearning] = []
        self._before = {name: own for name, own in vars(model).items() if name in REPLACED}
        model.train, model._excluded_save_params = self, self._left_out

    def __call__(self, *arguments: Any, **keywords: Any) -> None:
        self._remove()
        train = self._earlier("train")
        try:
            for callback in self.callbacks:
                train = callback._change() or train
            train(*arguments, **keywords)
        finally:  # after Ctrl-C, too: then the model is saved, or learns on without the callbacks
            self._undo()

    def end(self) -> None:
        """Let the model learn by its own ``train``."""
        self._remove()
        self._undo()

    def _earlier(self, name: str) -> Callable[..., Any]:
        """Return the method that was replaced."""
        own = getattr(type(self._model), name).__get__(self._model)
        return cast(Callable[..., Any], self._before.get(name, own))

    def _left_out(self) -> list[str]:
        """Name what a saved file leaves out; see SB3's method of this name."""
        return [*self._earlier("_excluded_save_params")(), *REPLACED]

    def _remove(self) -> None:
        if vars(self._model).get("train") is self:
            for name in REPLACED:
                delattr(self._model, name)
            vars(self._model).update(self._before)

    def _undo(self) -> None:
        for callback in self.callbacks:
            callback._undo()


def end_changes(model: BaseAlgorithm) -> None:
    """
    Undo what callbacks changed for an update that an interrupt has prevented.

    :param model: whose training has ended
    """
    training = vars(model).get("train")
    if isinstance(training, _Training):
        training.end()


class WhileLearning(BaseCallback):
    """
    Base of callbacks that change the algorithm only while it learns.

    They change it when a rollout has ended and the algorithm begins to learn from it, and undo that
    when it has learned, so that models that other callbacks save are unchanged.
    """

    def _on_step(self) -> bool:
        return True

    @abstractmethod
    def _change(self) -> Callable[..., None] | None:
        """Change the algorithm; return what learns instead of ``train``, if something does."""

    @abstractmethod
    def _undo(self) -> None:
        """Undo the change, if there is one."""

    def _on_rollout_start(self) -> None:
        self._end()  # off-policy algorithms do not learn before `learning_starts`

    def _on_rollout_end(self) -> None:
        training = vars(self.model).get("train")
        if not isinstance(training, _Training):
            training = _Training(self.model)
        training.callbacks.append(self)

    def _on_training_end(self) -> None:
        self._end()

    def _end(self) -> None:
        end_changes(self.model)
        self._undo()


class LeanUpdatesCallback(WhileLearning):
    """
    Update DDPG or TD3 with a ``SplitHeadPolicy``, or PPO, without PyTorch's record of operations.

    Use it in every training on the CPU by one of these algorithms: it takes about half of the time.

    The updates are equal but for rounding. PPO decides in this way, too. While it is active, the
    parameters of DDPG and TD3 are views of a few vectors. If the policy is on a GPU, or has a part
    that the passes do not know (an optimizer, an activation, a features extractor, a hook), then
    the algorithm's own methods go on. This is checked before each rollout and each update, so other
    callbacks may change the model.

    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, verbose: int = 0) -> None:
        super().__init__(verbose)
        self._updates: LeanUpdates | None = None  # of DDPG and TD3

    def _on_training_start(self) -> None:
        self._release()  # SB3 does not end the callbacks of a training that an error has ended
        model = self.model
        split = isinstance(model, TD3) and isinstance(model.policy, SplitHeadPolicy)
        if not split and not isinstance(model, PPO):
            raise InvalidOption(
                f"{type(self).__name__} updates PPO, and DDPG and TD3 with SplitHeadPolicy, but "
                f"the model learns by {type(model).__name__} with {type(model.policy).__name__}; "
                "take it out of the callbacks"
            )

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        model = self.model
        if isinstance(model, PPO) and ppo.is_for(model):
            lean = LeanPPO(model)
            lean.read_parameters()
            vars(model.policy)["forward"] = LeanForward(lean)
        elif isinstance(model, TD3) and self._updates is None and updates.is_for(model):
            self._updates = LeanUpdates(model)  # the actor decides in another way, too

    def _change(self) -> Callable[..., None] | None:
        self._undo()
        model = self.model
        if isinstance(model, PPO):
            return LeanPPO(model).train if ppo.is_for(model) else None
        assert isinstance(model, TD3)
        if self._updates is not None and not (
            self._updates.model is model and updates.is_for(model) and self._updates.is_whole()
        ):
            self._release()
        if self._updates is None and updates.is_for(model):
            self._updates = LeanUpdates(model)
        return None if self._updates is None else self._updates.train

    def _on_training_end(self) -> None:
        super()._on_training_end()
        self._release()

    def _release(self) -> None:
        if self._updates is not None:
            self._updates.release()
            self._updates = None

    def _undo(self) -> None:
        if isinstance(vars(self.model.policy).get("forward"), LeanForward):
            del vars(self.model.policy)["forward"]
