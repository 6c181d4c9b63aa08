"""PPO with lean updates learns what stock PPO learns, but for rounding, and saves stock models."""

import copy
import os
from contextlib import closing
from itertools import permutations

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn
from toy import ToyRace

from sb3_torcs.callbacks import LeanUpdatesCallback
from sb3_torcs.callbacks.adapting import AdaptiveLearningRateCallback, ValuesOnlyCallback
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.policies.ppo import LeanPPO, is_for
from sb3_torcs.vec_env import TorcsVecEnv

RELU = {"activation_fn": nn.ReLU}
SMALL = {"net_arch": {"pi": [8], "vf": [12, 6]}, **RELU}


def make(policy_kwargs=SMALL, policy="MlpPolicy", env=None, **kwargs):
    """Rollouts of 40 timesteps in three unequal batches."""
    arguments = {"n_steps": 40, "batch_size": 16, "n_epochs": 3, "learning_rate": 0.01, **kwargs}
    with pytest.warns(UserWarning, match="truncated mini-batch"):
        return PPO(policy, env or ToyRace(), policy_kwargs=policy_kwargs, seed=0, **arguments)


def learned(model, callback=None):
    """What three rollouts with their updates come to, and the state of SB3's random numbers."""
    model.set_random_seed(1)
    model.learn(120, callback=callback)
    buffer = model.rollout_buffer
    return [
        model.policy.state_dict(),
        model.policy.optimizer.state_dict(),
        [buffer.actions, buffer.values, buffer.log_probs, buffer.advantages],
        th.get_rng_state(),
        np.random.get_state()[1],  # noqa: NPY002
    ]


@pytest.mark.parametrize("kwargs", [
    {}, {"ent_coef": 0.1, "vf_coef": 0.2}, {"normalize_advantage": False},
    {"clip_range": 0.01, "max_grad_norm": 10.0},
    {"policy_kwargs": {"net_arch": [8, 8], "log_std_init": -1.0, **RELU}},
    {"policy_kwargs": {**SMALL, "share_features_extractor": False}}, {"policy": BoundedPolicy},
    {"policy_kwargs": {**SMALL, "optimizer_kwargs": {"weight_decay": 0.1}}},
])  # fmt: skip
def test_lean_updates_learn_as_ppo_does(kwargs):
    """The same random numbers, log and state of Adam; tolerance: float32 in another order."""
    stock, lean = make(**kwargs), make(**kwargs)
    found = learned(lean, LeanUpdatesCallback())
    th.testing.assert_close(learned(stock), found, rtol=1e-4, atol=1e-4)
    logs = [dict(model.logger.name_to_value) for model in (stock, lean)]
    assert logs[0] == pytest.approx(logs[1], rel=1e-3, abs=1e-5)
    assert stock._n_updates == lean._n_updates == 9


def test_one_core_learns_what_two_learn(monkeypatch):
    """To the bit; and so does the same seed once more."""
    found = []
    for cores in ({0}, {0, 1}, {0, 1}):
        monkeypatch.setattr(os, "sched_getaffinity", lambda process, cores=cores: cores)
        found.append(learned(make(), LeanUpdatesCallback()))
    th.testing.assert_close(found[0], found[1], rtol=0, atol=0)
    th.testing.assert_close(found[1], found[2], rtol=0, atol=0)


@pytest.mark.parametrize("kwargs", [
    {"policy_kwargs": {"net_arch": [8]}}, {"policy_kwargs": {**RELU, "net_arch": []}},
    {"policy_kwargs": {**SMALL, "optimizer_class": th.optim.SGD}},
    {"policy_kwargs": {**SMALL, "optimizer_kwargs": {"amsgrad": True}}},
    {"use_sde": True}, {"target_kl": 0.01}, {"clip_range_vf": 0.1},
])  # fmt: skip
def test_parts_that_lean_updates_do_not_know_learn_as_ever(kwargs):
    """PPO's own methods go on: to the bit what it is without the callback."""
    stock, lean = make(**kwargs), make(**kwargs)
    assert not is_for(lean)
    th.testing.assert_close(learned(stock), learned(lean, LeanUpdatesCallback()), rtol=0, atol=0)


def test_the_model_is_a_stock_one_whenever_it_may_be_saved(monkeypatch):
    """While it updates (Ctrl-C comes then, as a rule), and afterwards."""
    model, found = make(), []
    get = model.rollout_buffer.get

    def noted(batch_size):
        found.append({"train", "forward"} & {*vars(model), *vars(model.policy)})
        return get(batch_size)

    monkeypatch.setattr(model.rollout_buffer, "get", noted)
    model.learn(120, callback=LeanUpdatesCallback())
    assert found == [set()] * 9
    assert not {"train", "forward"} & {*vars(model), *vars(model.policy)}


def test_what_was_learned_before_ctrl_c_is_kept(monkeypatch):
    model, reference = make(), make(n_epochs=1)
    get, passes = model.rollout_buffer.get, []

    def interrupted(batch_size):
        if passes:
            raise KeyboardInterrupt
        passes.append(batch_size)
        return get(batch_size)

    monkeypatch.setattr(model.rollout_buffer, "get", interrupted)
    model.set_random_seed(1)
    with pytest.raises(KeyboardInterrupt):
        model.learn(40, callback=LeanUpdatesCallback())
    reference.set_random_seed(1)
    reference.learn(40, callback=LeanUpdatesCallback())
    states = [each.policy.state_dict() for each in (model, reference)]
    th.testing.assert_close(*states, rtol=0, atol=0)


def interrupted(model, when, *callbacks):
    """Learn until Ctrl-C comes: in the third timestep, in the first update, or just before it."""

    class CtrlC(BaseCallback):
        def _on_step(self):
            if when == "rollout" and self.n_calls == 3:
                raise KeyboardInterrupt
            return True

        def _on_rollout_end(self):
            if when == "before":
                raise KeyboardInterrupt

    if when == "update":
        model.rollout_buffer.get = lambda batch_size: (_ for _ in ()).throw(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        model.learn(80, callback=[*callbacks, CtrlC()])
    vars(model.rollout_buffer).pop("get", None)


@pytest.mark.parametrize("when", ["rollout", "before", "update"])
@pytest.mark.parametrize(
    "kinds", [*permutations([LeanUpdatesCallback, AdaptiveLearningRateCallback])]
)
def test_a_model_is_saved_after_ctrl_c(when, kinds, tmp_path):
    """Its environment cannot be pickled, so nothing of the callbacks may be left in it."""
    with closing(TorcsVecEnv(2, env_id="TorcsLite-v0", threads=1)) as cars:
        model = make(env=cars, n_steps=20, batch_size=12)
        interrupted(model, when, *(kind() for kind in kinds))
        model.save(tmp_path / "model")
        assert PPO.load(tmp_path / "model").lr_schedule(1.0) == model.learning_rate


def test_what_ctrl_c_left_behind_decides_no_more_after_an_update():
    """A fused Adam changes parameters without a trace."""
    model = make(policy_kwargs={**SMALL, "optimizer_kwargs": {"fused": True}})
    interrupted(model, "rollout", LeanUpdatesCallback())
    seen = th.zeros(1, model.observation_space.shape[0])
    assert model.policy(seen)[1].requires_grad
    model.learn(80)
    with th.no_grad():
        assert model.policy(seen)[1] == model.policy.predict_values(seen)


def test_a_training_after_ctrl_c_needs_no_callback():
    model, reference = make(), make()
    for each in (model, reference):
        interrupted(each, "rollout", *([LeanUpdatesCallback()] if each is model else []))
        each.set_random_seed(1)
        each.learn(80)
    states = [each.policy.state_dict() for each in (model, reference)]
    th.testing.assert_close(*states, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("frozen", ["log_std", "value_net.bias"])
def test_what_is_frozen_stays(frozen):
    model = make()
    own = model.policy.get_parameter(frozen).requires_grad_(False)
    before = own.clone()
    model.learn(80, callback=LeanUpdatesCallback())
    assert own.equal(before)


def test_a_deterministic_action_is_the_mean():
    model = make()
    observations = th.rand(5, 29)
    lean = LeanPPO(model)
    lean.read_parameters()
    with th.no_grad():
        expected = model.policy.forward(observations, deterministic=True)
    found = lean.forward(observations, deterministic=True)
    th.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


# ------------------------------------------------------------------------- learning rate


class Rates(BaseCallback):
    """Notes the divergence and the rate of each update, and what a model saved in it would say."""

    def __init__(self):
        super().__init__()
        self.seen, self.saved = [], set()

    def _on_step(self):
        self.saved.add(self.model.lr_schedule(1.0))
        return True

    def _on_rollout_start(self):
        logged = self.logger.name_to_value
        if "train/approx_kl" in logged:
            self.seen.append((logged["train/approx_kl"], logged["train/learning_rate"]))


@pytest.mark.parametrize(("kl", "last"), [(1e-9, 0.01 / 1.5**3), (1e3, 0.01 * 1.5**3)])
def test_the_learning_rate_follows_the_divergence(kl, last):
    """It falls where updates change the policy too much, and rises where they change it little."""
    model, rates = make(), Rates()
    model.learn(200, callback=[AdaptiveLearningRateCallback(kl=kl), rates])
    assert len(rates.seen) == 4
    assert rates.seen[0][1] == 0.01
    assert rates.seen[-1][1] == pytest.approx(last)
    assert rates.saved == {0.01}


def test_within_the_target_the_learning_rate_is_the_models_own():
    first = make()
    first.learn(80, callback=(rates := Rates()))
    model = make()
    target = rates.seen[0][0]
    model.learn(120, callback=[AdaptiveLearningRateCallback(kl=target), rates := Rates()])
    assert [rate for _, rate in rates.seen] == [0.01, 0.01]
    assert model.lr_schedule(1.0) == 0.01


def test_a_target_that_falls_is_missed_later():
    """What is within the target in the beginning is far beyond it in the end."""
    model = make()
    model.learn(20)
    callback = AdaptiveLearningRateCallback(kl=0.02, last_kl=0.001)
    callback.init_callback(model)
    callback.on_training_start({}, {})
    factors = []
    for remaining in (1.0, 0.5, 0.0):
        model.logger.record("train/approx_kl", 0.015)
        model._current_progress_remaining = remaining
        callback.on_rollout_start()
        factors.append(callback.factor)
    assert factors == [1.0, 1.0, 1.0 / 1.5]


def test_the_first_steps_may_be_smaller_and_a_resumed_training_goes_on_with_its_own():
    model = make()
    callback = AdaptiveLearningRateCallback(kl=1e9, first_factor=0.1)
    model.learn(120, callback=[callback, rates := Rates()])
    assert [rate for _, rate in rates.seen] == pytest.approx([0.001, 0.0015])
    again = AdaptiveLearningRateCallback(kl=1e9, first_factor=0.1)
    model.learn(40, callback=again, reset_num_timesteps=False)
    assert again.factor >= 0.2


@pytest.mark.parametrize("factor", [0.0, 5.0, float("nan"), "small"])
def test_no_such_first_factor(factor):
    with pytest.raises(InvalidOption, match=f"first_factor is {factor!r}; expected 0.01 to 4"):
        AdaptiveLearningRateCallback(first_factor=factor)


def test_only_ppo_tells_a_divergence():
    with pytest.raises(InvalidOption, match="the model learns by A2C; take it out"):
        A2C("MlpPolicy", ToyRace()).learn(5, callback=AdaptiveLearningRateCallback())
    for kl in (0.0, -1.0, "small"):
        with pytest.raises(InvalidOption, match="pass a divergence above 0"):
            AdaptiveLearningRateCallback(kl=kl)
        with pytest.raises(InvalidOption, match=r"last_kl is .* pass a divergence above 0"):
            AdaptiveLearningRateCallback(last_kl=kl)


# --------------------------------------------------------------------------- values only


@pytest.mark.parametrize("others", [(), (LeanUpdatesCallback,)])
@pytest.mark.parametrize("first", [True, False])
def test_only_the_value_function_learns(others, first):
    """The actions of a rollout are those of the policy as it was, in any order of the callbacks."""
    model = make()
    before = {name: own.clone() for name, own in model.policy.state_dict().items()}
    chances = []

    class Look(BaseCallback):
        def _on_step(self):
            with th.no_grad():
                seen, actions = self.locals["obs_tensor"], self.locals["actions"]
                _, chance, _ = model.policy.evaluate_actions(seen, th.as_tensor(actions))
            chances.append((chance, self.locals["log_probs"]))
            return True

    values, others = [ValuesOnlyCallback()], [callback() for callback in others]
    model.learn(80, callback=[*(values + others if first else others + values), Look()])
    for name, own in model.policy.state_dict().items():
        assert own.equal(before[name]) is ("value_net" not in name), name
    for expected, drawn in chances:
        th.testing.assert_close(drawn, expected)


def test_an_algorithm_without_such_a_value_function_is_told():
    model = SAC("MlpPolicy", ToyRace())
    with pytest.raises(InvalidOption, match="is for PPO and A2C, but the model learns by SAC"):
        model.learn(1, callback=ValuesOnlyCallback())


class Copies(BaseCallback):
    """Keeps a copy of the policy of each rollout, as self-play does."""

    def _on_training_start(self):
        self.policies = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.policies.append(copy.deepcopy(self.model.policy))


@pytest.mark.parametrize("policy", ["MlpPolicy", BoundedPolicy])
def test_copies_of_a_policy_that_makes_a_rollout_stand_alone(policy, tmp_path):
    """The model, which writes for TensorBoard, could not be copied with them."""
    model, copies = make(policy=policy, tensorboard_log=str(tmp_path)), Copies()
    model.learn(80, callback=[LeanUpdatesCallback(), copies])
    first, second = copies.policies
    seen = th.zeros(1, 29)
    first.load_state_dict(second.state_dict())
    found, expected = (each(seen, deterministic=True) for each in (first, second))
    th.testing.assert_close(found, expected, rtol=0.0, atol=0.0)
    state = copy.deepcopy(first.state_dict())
    first.load_state_dict({name: own * 0.0 for name, own in state.items()})
    assert not th.equal(first(seen, deterministic=True)[1], expected[1])


def test_a_model_that_is_interrupted_before_an_update_is_saved(tmp_path):
    model = make(policy=BoundedPolicy, tensorboard_log=str(tmp_path))
    callbacks = [AdaptiveLearningRateCallback(first_factor=0.1), LeanUpdatesCallback()]
    buffer, schedule = model.rollout_buffer, model.lr_schedule
    interrupted(model, "before", *callbacks)
    assert (model.rollout_buffer, model.lr_schedule) == (buffer, schedule)
    model.save(tmp_path / "model.zip")
    again = PPO.load(tmp_path / "model.zip", ToyRace())
    assert not {"train", "_excluded_save_params"} & vars(again).keys()
    again.learn(40)
    assert again._n_updates == 3
