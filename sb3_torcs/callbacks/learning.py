"""Callbacks that change how a training learns: its updates, its learning rate, its samples."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import torch as th
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_torcs.callbacks.progress import RacingProgressCallback
from sb3_torcs.callbacks.tree import require_method
from sb3_torcs.car import check_count, is_number
from sb3_torcs.errors import InvalidOption, renamed
from sb3_torcs.policies import ppo, updates
from sb3_torcs.policies.mirror import check_angles, mirror_image
from sb3_torcs.policies.mirrored_replay import sample_mirrored
from sb3_torcs.policies.ppo import LeanForward, LeanPPO
from sb3_torcs.policies.split_head import SplitHeadPolicy
from sb3_torcs.policies.updates import LeanUpdates

__all__ = [
    "AdaptiveLearningRateCallback",
    "GradientStepsCallback",
    "LeanUpdatesCallback",
    "MirrorCallback",
    "ValuesOnlyCallback",
    "WhileLearning",
    "end_changes",
    "learn_values",
]

RATE_STEP = 1.5  # [-] by which the learning rate changes after an update
LEAST_RATE, MOST_RATE = 0.01, 4.0  # [-] of the model's own
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


class GradientStepsCallback(WhileLearning):
    """
    Take more gradient steps at the beginning of a training, when there are few timesteps.

    A resumed training with its replay buffer counts as past its beginning. Models that callbacks
    save keep their own ``gradient_steps``.

    :param gradient_steps: replace the model's own at the beginning
    :param timesteps: length of the beginning, of all environments together
    :param verbose: as in ``BaseCallback``
    """

    @renamed(frames="timesteps")
    def __init__(self, *, gradient_steps: int, timesteps: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        check_count("gradient_steps", gradient_steps)
        check_count("timesteps", timesteps)
        self.gradient_steps = gradient_steps
        self.timesteps = timesteps

    def _on_training_start(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise InvalidOption(
                f"{type(self).__name__} sets the gradient steps of off-policy algorithms, but the "
                f"model learns by {type(self.model).__name__}; take it out of the callbacks"
            )
        end_changes(self.model)  # of a training that an error has ended
        self._algorithm, self._own = self.model, self.model.gradient_steps

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        # At once: the algorithm reads it before it calls `train`.
        buffer = self._algorithm.replay_buffer
        remembered = 0 if buffer is None else buffer.size() * buffer.n_envs
        if max(self.num_timesteps, remembered) <= self.timesteps:
            self._algorithm.gradient_steps = self.gradient_steps

    def _change(self) -> None:
        """Do nothing: the steps were changed at the end of the rollout."""

    def _undo(self) -> None:
        self._algorithm.gradient_steps = self._own


class LeanUpdatesCallback(WhileLearning):
    """
    Update DDPG or TD3 with a ``SplitHeadPolicy``, or PPO, without PyTorch's record of operations.

    The updates are equal but for rounding, and take about half of the time. PPO decides in this
    way, too. If the policy is on a GPU, or has a part that the passes do not know (an optimizer, an
    activation, a features extractor, a hook), then the algorithm's own methods go on. This is
    checked before each rollout and each update, so other callbacks may change the model.

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


class AdaptiveLearningRateCallback(WhileLearning):
    """
    Scale PPO's learning rate so that each update changes the policy about equally much.

    As exploration fades, the same step changes what a Gaussian policy does more and more. So the
    rate falls by a factor of 1.5 after an update whose divergence from the policy before is more
    than twice the target, and rises by it after one with less than half of the target (Schulman et
    al., 2017, section 4, adapt a penalty in the same way). The model's own schedule goes on below;
    models that callbacks save keep it, and the factor, too, as ``learning_rate_factor``: a resumed
    training goes on with it.

    With a target that stays, a policy never settles: what it drives well changes from update to
    update. A target that falls lets it come to rest.

    :param kl: target of the divergence per update [nats]
    :param last_kl: the same at the end of the training, to which it falls linearly [nats]; ``None``
        is ``kl``
    :param first_factor: on the model's learning rate at the beginning, 0.01 to 4. With one below 1
        the first updates take little of what a good policy knows
    :param verbose: as in ``BaseCallback``
    :raises InvalidOption: if a target is not above 0, the factor is out of its range, or the model
        is not PPO
    """

    def __init__(
        self,
        *,
        kl: float = 0.01,
        last_kl: float | None = None,
        first_factor: float = 1.0,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        last_kl = kl if last_kl is None else last_kl
        for name, target in (("kl", kl), ("last_kl", last_kl)):
            if not is_number(target) or target <= 0.0:
                raise InvalidOption(f"{name} is {target!r}; pass a divergence above 0, e.g. 0.01")
        if not is_number(first_factor) or not LEAST_RATE <= first_factor <= MOST_RATE:
            raise InvalidOption(
                f"first_factor is {first_factor!r}; expected {LEAST_RATE:g} to {MOST_RATE:g}"
            )
        self.kl, self.last_kl, self.first_factor = kl, last_kl, first_factor

    @property
    def factor(self) -> float:
        """By which the model's own learning rate is multiplied."""
        return float(vars(self.model).get("learning_rate_factor", self.first_factor))

    def _on_training_start(self) -> None:
        if not isinstance(self.model, PPO):
            raise InvalidOption(
                f"{type(self).__name__} reads the divergence that PPO logs, but the model learns "
                f"by {type(self.model).__name__}; take it out of the callbacks"
            )
        self._own = self.model.lr_schedule

    def _set_factor(self, factor: float) -> None:
        self.model.learning_rate_factor = factor  # type: ignore[attr-defined]  # so that it is saved

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        remaining = self.model._current_progress_remaining
        target = self.last_kl + remaining * (self.kl - self.last_kl)
        kl = self.logger.name_to_value.get("train/approx_kl")
        if kl is not None and kl > 2.0 * target:
            self._set_factor(max(self.factor / RATE_STEP, LEAST_RATE))
        elif kl is not None and kl < 0.5 * target:
            self._set_factor(min(self.factor * RATE_STEP, MOST_RATE))

    def _change(self) -> None:
        self.model.lr_schedule = self._scaled

    def _scaled(self, progress_remaining: float) -> float:
        return self.factor * self._own(progress_remaining)

    def _undo(self) -> None:
        self.model.lr_schedule = self._own


class ValuesOnlyCallback(BaseCallback):
    """
    Put the policy of PPO or A2C back after each update, so that only its value function learns.

    A student, and most shipped agents, drive, but come without a value function, and a new one may
    spoil them. So let the value function learn first, in a training of its own, as
    :func:`learn_values` does; in a second training, without this callback, both learn.

    :param verbose: as in ``BaseCallback``
    :raises InvalidOption: if the algorithm is another
    """

    def __init__(self, *, verbose: int = 0) -> None:
        super().__init__(verbose)

    def _on_training_start(self) -> None:
        policy = self.model.policy
        if not isinstance(policy, ActorCriticPolicy):
            raise InvalidOption(
                f"{type(self).__name__} is for PPO and A2C, but the model learns by "
                f"{type(self.model).__name__}; take it out of the callbacks"
            )
        parts = policy.mlp_extractor.value_net, policy.value_net
        values = {id(own) for part in parts for own in part.parameters()}
        state = *policy.parameters(), *policy.buffers()  # a buffer counts what an average has seen
        others = [own for own in state if id(own) not in values]
        self._policy = [(own, own.detach().clone()) for own in others]

    def _on_rollout_start(self) -> None:
        with th.no_grad():
            for own, before in self._policy:
                own.copy_(before)

    def _on_training_end(self) -> None:
        self._on_rollout_start()

    def _on_step(self) -> bool:
        return True


def learn_values(model: PPO, timesteps: int) -> None:
    """
    Let the value function of a model learn, and leave its policy as it is; show the progress.

    The next training begins with a fresh optimizer, and with the learning rate that it asks for.

    :param model: with a policy that drives already
    :param timesteps: to learn from
    """
    model.learn(
        timesteps,
        callback=[
            ValuesOnlyCallback(),
            RacingProgressCallback(),
            LeanUpdatesCallback(),
            AdaptiveLearningRateCallback(kl=0.03),
        ],
    )
    # Both come of updates of the policy, too, which were taken back.
    vars(model).pop("learning_rate_factor", None)
    model.policy.optimizer.state.clear()


class MirrorCallback(WhileLearning):
    """
    Mirror half of each batch from left to right, so that its bends go the other way.

    The replay buffer holds the transitions as they were driven, and saved files are those of SB3.

    :param verbose: as in ``BaseCallback``
    """

    def __init__(self, *, verbose: int = 0) -> None:
        super().__init__(verbose)

    def _on_training_start(self) -> None:
        buffer = getattr(self.model, "replay_buffer", None)
        if not isinstance(buffer, ReplayBuffer):
            raise InvalidOption(
                f"{type(self).__name__} mirrors samples of a replay buffer, but "
                f"{type(self.model).__name__} has none; take it out of the callbacks"
            )
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None and normalizer.norm_obs:
            raise InvalidOption(
                f"{type(self).__name__} needs observations whose middle is 0, which VecNormalize "
                "moves; take 'normalize' away: the observations are scaled already"
            )
        require_method(self.training_env, "range_finder_angles")
        for angles in self.training_env.get_attr("range_finder_angles"):
            check_angles(angles, type(self).__name__)
        try:
            mirror_image(buffer.observation_space)
        except InvalidOption as error:
            raise InvalidOption(f"{type(self).__name__}: {error}") from error
        self._buffer = buffer

    def _change(self) -> None:
        self._buffer.sample = _MirroredSample(self._buffer)  # type: ignore[method-assign]

    def _undo(self) -> None:
        vars(self._buffer).pop("sample", None)


class _MirroredSample:
    """Replaces the ``sample`` of a replay buffer."""

    def __init__(self, buffer: ReplayBuffer) -> None:
        self._buffer = buffer

    def __call__(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return sample_mirrored(self._buffer, batch_size, env)

    def __reduce__(self) -> tuple[Any, ...]:
        # After Ctrl-C the buffer may be saved while it is replaced: pickle its own method.
        return partial, (type(self._buffer).sample, self._buffer)
