"""What the scripts that train racers change: PPO's learning rate, and what of it learns."""

from __future__ import annotations

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_torcs.callbacks.learning import LeanUpdatesCallback, WhileLearning
from sb3_torcs.callbacks.progress import RacingProgressCallback
from sb3_torcs.car import is_number
from sb3_torcs.errors import InvalidOption

__all__ = ["AdaptiveLearningRateCallback", "ValuesOnlyCallback", "learn_values"]

RATE_STEP = 1.5  # [-] by which the learning rate changes after an update
LEAST_RATE, MOST_RATE = 0.01, 4.0  # [-] of the model's own


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
