"""PPO that learns from its last rollouts."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO
from torch import nn
from toy import ToyRace

from sb3_torcs.callbacks import LeanUpdatesCallback, ReuseRolloutsCallback
from sb3_torcs.callbacks.learning import WhileLearning
from sb3_torcs.callbacks.reuse import _learn_again, _taken
from sb3_torcs.errors import InvalidOption

SIZE = 20


def make(of=PPO, **kwargs):
    arguments = {
        "n_steps": SIZE, "batch_size": 10, "n_epochs": 2, "learning_rate": 0.01,
        "policy_kwargs": {"net_arch": [8], "activation_fn": nn.ReLU}, "gamma": 0.9,
        "gae_lambda": 0.8, "seed": 0,
    }  # fmt: skip
    return of("MlpPolicy", ToyRace(), **{**arguments, **kwargs})


def learned(callback=None, rollouts=4, model=None):
    """A model after so many rollouts, by the same random numbers each time."""
    model = model or make()
    model.set_random_seed(1)
    return model.learn(rollouts * SIZE, callback=callback)


def weights(model):
    return th.cat([own.detach().flatten() for own in model.policy.parameters()])


class Kept(WhileLearning):
    """Keeps the rollouts, and the sizes from which the model learned."""

    def __init__(self):
        super().__init__()
        self.rollouts, self.sizes = [], []

    def _on_step(self):
        assert self.model.rollout_buffer.n_envs == 1  # whenever the model may be saved
        return True

    def _on_rollout_end(self):
        super()._on_rollout_end()
        self.rollouts.append(_taken(self.model.rollout_buffer, self.locals))

    def _change(self):
        self.sizes.append(self.model.rollout_buffer.n_envs)

    def _undo(self):
        pass


def test_one_rollout_is_what_ppo_learns_from_anyway():
    """To the bit, the log included."""
    stock, same = learned(), learned(ReuseRolloutsCallback(rollouts=1))
    assert th.equal(weights(stock), weights(same))
    logs = [
        {name: value for name, value in model.logger.name_to_value.items() if "time/" not in name}
        for model in (stock, same)
    ]
    assert logs[0] == logs[1]


def test_the_last_rollouts_are_learned_from_and_the_same_seed_learns_the_same():
    found = []
    for _ in range(2):
        model = learned([ReuseRolloutsCallback(rollouts=3), kept := Kept()], rollouts=5)
        assert kept.sizes == [1, 2, 3, 3, 3]
        assert model.rollout_buffer.n_envs == 1
        found.append(weights(model))
    assert th.equal(*found)


def test_lean_updates_learn_the_same():
    """Tolerance: float32 in another order."""
    stock = learned(ReuseRolloutsCallback(rollouts=2))
    lean = learned([LeanUpdatesCallback(), ReuseRolloutsCallback(rollouts=2)])
    th.testing.assert_close(weights(stock), weights(lean), rtol=1e-4, atol=1e-4)


def test_a_rollout_of_todays_policy_tells_what_it_tells_ppo():
    """Tolerance: values of one observation at a time and of all at once differ in rounding."""
    model = learned(kept := Kept(), rollouts=1, model=make(learning_rate=0.0))
    again, buffer = _learn_again(model, kept.rollouts[0]), model.rollout_buffer
    for name in ("values", "log_probs", "advantages", "returns"):
        stock = getattr(buffer, name).reshape(-1)  # which learning has flattened
        np.testing.assert_allclose(getattr(again, name).reshape(-1), stock, rtol=1e-4, atol=1e-5)


def test_older_rollouts_count_by_v_trace():
    """Against equation 1 of the paper, term by term, with λ in its c."""
    model = learned(kept := Kept(), rollouts=1)
    old = kept.rollouts[0]
    model.learn(3 * SIZE)
    again = _learn_again(model, old)
    counts = np.minimum(np.exp(again.log_probs - old.log_probs), 1.0)[:, 0]
    assert counts.min() < 0.9
    goes_on = 1.0 - np.append(old.episode_starts[1:, 0], old.last_dones)
    last = model.policy.predict_values(th.from_numpy(old.last_observations)).item()
    values = np.append(again.values[:, 0], last)
    for first in range(SIZE):
        target, trace = values[first], 1.0
        for step in range(first, SIZE):
            following = goes_on[step] * values[step + 1]
            error = counts[step] * (old.rewards[step, 0] + 0.9 * following - values[step])
            target += trace * error
            trace *= 0.9 * 0.8 * counts[step] * goes_on[step]
        assert again.returns[first, 0] == pytest.approx(target, rel=1e-4, abs=1e-5)
    np.testing.assert_allclose(again.advantages, again.returns - again.values, rtol=1e-4, atol=1e-5)


def test_ctrl_c_leaves_the_models_own_buffer():
    class Interrupted(PPO):
        train_again = False

        def train(self):
            if not self.train_again:
                raise KeyboardInterrupt
            super().train()

    model = make(of=Interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(SIZE, callback=ReuseRolloutsCallback(rollouts=2))
    assert model.rollout_buffer.n_envs == 1
    model.train_again = True
    model.learn(2 * SIZE)


@pytest.mark.parametrize("rollouts", [0, -1, 2.5, "many", True])
def test_no_such_number_of_rollouts(rollouts):
    with pytest.raises(InvalidOption, match=f"rollouts is {rollouts!r}; "):
        ReuseRolloutsCallback(rollouts=rollouts)


def test_other_algorithms_and_spaces_are_told():
    with pytest.raises(InvalidOption, match="the model learns by A2C; take it out"):
        A2C("MlpPolicy", ToyRace()).learn(5, callback=ReuseRolloutsCallback())
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8)
    with pytest.raises(InvalidOption, match=r"needs a Box of actions, not Discrete\(2\)"):
        model.learn(8, callback=ReuseRolloutsCallback())
