"""The policy: its networks, that its shortcuts change no bit, and that it survives a file."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
import time
from copy import deepcopy
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn
from toy import ToyRace

from sb3_torcs.bench.policy import updater
from sb3_torcs.callbacks import LeanUpdatesCallback
from sb3_torcs.callbacks.learning import end_changes
from sb3_torcs.callbacks.replay import GradientStepsCallback
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies import SplitHeadPolicy
from sb3_torcs.policies import updates as lean_updates
from sb3_torcs.policies.mirror import mirror_actions, mirror_image, mirror_observations
from sb3_torcs.policies.threads import two_threads
from sb3_torcs.policies.updates import LeanUpdates, is_for
from sb3_torcs.sensors import View

SMALL = [16, 24]
OBSERVATIONS = np.random.default_rng(0).uniform(-1, 1, (5, 29)).astype(np.float32)


class Extractor(FlattenExtractor):
    """A features extractor that is not SB3's."""


def make_model(algorithm=DDPG, policy="SplitHeadPolicy", **kwargs):
    policy_kwargs = {"net_arch": SMALL, **kwargs}
    env = DummyVecEnv([ToyRace])
    model = algorithm(
        policy, env, policy_kwargs=policy_kwargs, learning_starts=5, batch_size=8,
        buffer_size=500, seed=0, device="cpu",
    )  # fmt: skip
    model.set_logger(Logger(None, []))
    return model


def assert_same(one: list[th.Tensor], two: list[th.Tensor]) -> None:
    for a, b in zip(one, two, strict=True):
        assert th.equal(a, b)


# ------------------------------------------------------------------------------- networks


def test_the_networks_are_those_of_the_post():
    """300 and 600 units: 191,403 parameters, and 554,403 less the critic's two extra outputs."""
    policy = make_model(net_arch=None).policy
    assert sum(p.numel() for p in policy.actor.parameters()) == 191_403
    assert sum(p.numel() for p in policy.critic.parameters()) == 554_403 - 2 * 601


@pytest.mark.parametrize(("bias", "brake"), [(None, 0.5), ((0, 0, -2), 1 / (1 + np.exp(2)))])
def test_an_untrained_driver_holds_the_wheel_straight_with_half_of_both_pedals(bias, brake):
    """Heads of N(0, 1e-4) and no bias: tanh(0) and sigmoid(0); a bias starts with less brake."""
    actions, _ = make_model(**({"head_bias": bias} if bias else {})).predict(OBSERVATIONS)
    np.testing.assert_allclose(actions, [[0.0, 0.5, brake]] * 5, atol=1e-3)


@pytest.mark.parametrize("heads", [("tanh", "sigmoid", "sigmoid"), ("sigmoid", "tanh", "tanh")])
def test_the_heads_are_tanh_and_sigmoid_in_environment_units(heads):
    """tanh(z) or 2 sigmoid(z) - 1, then scaled by SB3; within float32."""
    model = make_model(heads=heads, init_std=1.0)
    mu = model.actor.mu
    with th.no_grad():
        z = th.as_tensor(OBSERVATIONS)
        for layer in mu.hidden:
            z = th.relu(nn.functional.linear(z, layer.weight, layer.bias))
        z = nn.functional.linear(z, mu.heads.weight, mu.heads.bias).double()
    function = {"tanh": th.tanh, "sigmoid": lambda x: 2 * th.sigmoid(x) - 1}
    scaled = th.stack([function[head](z[:, i]) for i, head in enumerate(heads)], dim=1)
    expected = model.policy.unscale_action(scaled.numpy())
    np.testing.assert_allclose(model.predict(OBSERVATIONS)[0], expected, atol=1e-6)


def test_the_heads_start_from_the_given_deviation():
    """N(0, init_std); four standard errors of 1800 weights."""
    weights = make_model(net_arch=None, init_std=0.5).actor.mu.heads.weight
    assert weights.std().item() == pytest.approx(0.5, rel=4 / np.sqrt(2 * 1800))
    assert not make_model().actor.mu.heads.bias.any()


def test_the_action_joins_the_critic_at_the_second_layer():
    """relu(W3 (W2 relu(W1 s) + Wa a)), written out."""
    critic = make_model().critic
    (network,) = critic.networks
    state, action = th.rand(7, 29), th.rand(7, 3)

    def lin(layer, x):
        return x @ layer.weight.t() + layer.bias

    joint = lin(network.state2, th.relu(lin(network.state1, state))) + lin(network.action2, action)
    expected = lin(network.value, th.relu(lin(network.joint3, joint)))
    th.testing.assert_close(network(state, action), expected)
    th.testing.assert_close(critic(state, action)[0], expected)
    assert expected.shape == (7, 1)


@pytest.mark.parametrize(("algorithm", "kwargs", "n_critics"), [
    (DDPG, {}, 1), (DDPG, {"n_critics": 2}, 2), (TD3, {}, 2),
])  # fmt: skip
def test_the_number_of_critics_is_respected(algorithm, kwargs, n_critics):
    model = make_model(algorithm, **kwargs)
    assert len(model.critic(th.rand(4, 29), th.rand(4, 3))) == n_critics
    model.learn(20)
    assert model._n_updates > 0


@pytest.mark.parametrize("kwargs", [
    {"layer_norm": True}, {"net_arch": {"pi": [8, 8, 8], "qf": [8, 4]}},
    {"activation_fn": nn.ELU}, {"share_features_extractor": True},
    {"optimizer_class": th.optim.SGD}, {"optimizer_class": th.optim.AdamW},
    {"optimizer_kwargs": {"weight_decay": 1e-4}},
])  # fmt: skip
def test_the_policy_trains_with_other_parts(kwargs):
    model = make_model(**kwargs)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(20)
    after = list(model.actor.parameters())
    assert all(parameter.isfinite().all() for parameter in after)
    assert any(not th.equal(a, b) for a, b in zip(before, after, strict=True))


def test_layer_norm_is_in_the_hidden_layers_of_both_networks():
    """Two in the actor, and in the critic the first and the third layer."""
    policy = make_model(layer_norm=True).policy
    for network in (policy.actor.mu, *policy.critic.networks):
        assert sum(isinstance(module, nn.LayerNorm) for module in network.modules()) == 2


def test_other_numbers_of_actions_take_other_heads():
    """Heads are configurable per action dimension; a mirror image is known of ours only."""
    env = DummyVecEnv([ToyRace])
    env.action_space = spaces.Box(-1, 1, (4,))
    kwargs = {"heads": ("tanh",) * 4}
    model = DDPG("SplitHeadPolicy", env, policy_kwargs=kwargs, buffer_size=10)
    assert model.predict(OBSERVATIONS)[0].shape == (5, 4)
    with pytest.raises(InvalidOption, match="pass symmetric=False"):
        DDPG("SplitHeadPolicy", env, policy_kwargs={**kwargs, "symmetric": True}, buffer_size=10)


@pytest.mark.parametrize(("kwargs", "message"), [
    ({"heads": ("tanh", "relu", "sigmoid")}, "each head is 'tanh' or 'sigmoid'"),
    ({"heads": "tanh"}, "each head is 'tanh' or 'sigmoid'"),
    ({"heads": ("tanh",)}, "has 1 entries, but the action space has 3 actions"),
    ({"head_bias": (0, 1)}, "has 2 entries, but the action space has 3 actions"),
    ({"head_bias": (0, 0, np.nan)}, "pass one finite number per action"),
    ({"head_bias": 0}, "pass one finite number per action"),
    ({"head_bias": "abc"}, "pass one finite number per action"),
    ({"net_arch": {"pi": [8], "qf": [8, 8], "x": [1]}}, "the critic has two layer sizes"),
    ({"n_critics": 0}, "n_critics is 0; expected a whole number >= 1"),
    ({"layer_norm": "x"}, "layer_norm is 'x'; expected True or False"),
    ({"ema_decay": "x"}, "pass a share in"),
    ({"init_std": "x"}, "pass a number above 0"),
    ({"net_arch": [300]}, "the critic has two layer sizes"),
    ({"net_arch": [0, 64]}, "0 is no layer size; pass whole numbers >= 1"),
    ({"net_arch": 5}, "5 is no list of layer sizes; pass e.g. "),
    ({"net_arch": {"pi": 5, "qf": [8, 8]}}, "5 is no list of layer sizes; pass e.g. "),
    ({"head_bias": [0, [1]]}, r"head_bias=\[0, \[1\]\]: pass one finite number per action"),
    ({"net_arch": {"pi": [64.5], "qf": [8, 8]}}, "64.5 is no layer size"),
    ({"critic_lr_scale": 0.0}, "pass a number above 0"),
    ({"ema_decay": 1.0}, "pass a share in"),
    ({"symmetric": "no"}, "symmetric is 'no'; expected True or False"),
    ({"init_std": -1.0}, "pass a number above 0"),
])  # fmt: skip
def test_a_wrong_option_is_named_with_what_is_allowed(kwargs, message):
    """Before any network is built."""
    with pytest.raises(InvalidOption, match=message):
        make_model(**kwargs)


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC])
def test_other_algorithms_are_told_their_policies(algorithm):
    with pytest.raises(InvalidOption, match="a policy of DDPG and TD3; give PPO and A2C Bounded"):
        algorithm(SplitHeadPolicy, ToyRace())


# ------------------------------------------------------------------------------ shortcuts


ALIKE = [
    {}, {"n_critics": 2}, {"critic_lr_scale": 10.0}, {"layer_norm": True, "n_critics": 2},
    {"net_arch": {"pi": [8, 12, 16], "qf": [8, 4]}, "layer_norm": True},
]  # fmt: skip


def test_adam_is_fused_unless_somebody_chose_its_kernel():
    assert make_model().actor.optimizer.defaults["fused"] is True
    assert not make_model(optimizer_kwargs={"fused": False}).actor.optimizer.defaults["fused"]
    assert not make_model(optimizer_kwargs={"foreach": True}).actor.optimizer.defaults["fused"]
    assert type(make_model(optimizer_class=th.optim.SGD).actor.optimizer) is th.optim.SGD
    weight_decay = {"weight_decay": 0.1}
    assert make_model(optimizer_kwargs=weight_decay).actor.optimizer.defaults["weight_decay"] == 0.1
    assert weight_decay == {"weight_decay": 0.1}


def test_the_critic_learns_at_its_own_rate():
    """Adam's first step is the learning rate: ten times the actor's, whatever the schedule."""
    model = make_model(critic_lr_scale=10.0)
    nets = model.actor, model.critic
    before = [[p.detach().clone() for p in net.parameters()] for net in nets]
    model.learn(6)
    assert model._n_updates == 1
    steps = [
        max((p - q).abs().max().item() for p, q in zip(old, net.parameters(), strict=True))
        for old, net in zip(before, nets, strict=True)
    ]
    assert steps == pytest.approx([1e-3, 1e-2], rel=1e-3)
    assert model.critic.optimizer.param_groups[0]["lr"] == 1e-3


def test_the_average_drives_when_nothing_is_left_to_chance():
    """Each update leaves it its share; what explores is the actor itself."""
    model = make_model(ema_decay=0.75)
    model.learn(6)
    expected = [weight.clone() for weight in model.policy.driver.parameters()]
    for _ in range(3):
        model.train(1, 8)
        for weight, new in zip(expected, model.actor.parameters(), strict=True):
            weight.mul_(0.75).add_(0.25 * new)
    for weight, average in zip(expected, model.policy.driver.parameters(), strict=True):
        th.testing.assert_close(average, weight)
    scaled = model.policy.driver(th.as_tensor(OBSERVATIONS)).detach().numpy()
    drives, explores = (model.predict(OBSERVATIONS, deterministic=known)[0] for known in (1, 0))
    np.testing.assert_array_equal(drives, model.policy.unscale_action(scaled))
    assert not np.array_equal(drives, explores)


def test_each_update_moves_the_average_once_whatever_optimizers_there_were():
    """PyTorch wraps ``Adam.step`` when somebody makes the first one of a process."""
    th.optim.Adam([th.nn.Parameter(th.zeros(1))])
    model = make_model(ema_decay=0.75, optimizer_kwargs={"amsgrad": True})
    model.learn(6)
    assert model.policy.average.n_averaged == model._n_updates > 0


def test_the_average_of_a_copy_follows_the_copy():
    model = make_model(ema_decay=0.75)
    first = model.policy
    model.policy = deepcopy(first)
    model._create_aliases()
    model.learn(12)
    assert first.average.n_averaged == 0
    assert model.policy.average.n_averaged > 0


@pytest.mark.parametrize("ema_decay", [None, 0.9])
def test_predictions_follow_the_training(ema_decay):
    """They come from a copy in double precision, which must not be an old one."""
    model = make_model(ema_decay=ema_decay, init_std=0.5)
    for _ in range(3):
        model.learn(8, reset_num_timesteps=False)
        expected = model.policy.driver(th.as_tensor(OBSERVATIONS)).detach().numpy()
        found = model.predict(OBSERVATIONS, deterministic=True)[0]
        np.testing.assert_allclose(found, model.policy.unscale_action(expected), atol=1e-6)


def test_a_processor_that_rounds_otherwise_drives_the_same(tmp_path):
    """PyTorch's kernels for the oldest processors stand for another machine."""
    model = make_model(net_arch=[128, 128], layer_norm=True, init_std=0.5)
    model.save(tmp_path / "model")
    np.save(tmp_path / "seen.npy", np.random.default_rng(1).uniform(-1, 1, (2000, 29)))
    code = (
        "import sys, numpy as np; from stable_baselines3 import DDPG; folder = sys.argv[1];"
        "model = DDPG.load(folder + '/model', device='cpu');"
        "seen = np.load(folder + '/seen.npy').astype(np.float32);"
        "drive = lambda row: model.predict(row, deterministic=True)[0];"
        "np.save(sys.argv[2], [drive(row) for row in seen])"
    )
    drives = []
    for number, kernels in enumerate(({}, {"ATEN_CPU_CAPABILITY": "default"})):
        file = tmp_path / f"{number}.npy"
        command = [sys.executable, "-c", code, str(tmp_path), str(file)]
        subprocess.run(command, check=True, env={**os.environ, **kernels})
        drives.append(np.load(file))
    np.testing.assert_array_equal(*drives)


@pytest.mark.parametrize("kwargs", [{"ema_decay": 0.9}, {"symmetric": True}])
def test_what_drives_in_evaluations_changes_no_bit_of_the_training(kwargs):
    networks, explored = [], []
    for own in ({}, kwargs):
        model = updater("SplitHeadPolicy", 32, net_arch=SMALL, **own)
        model.train(10, 32)
        networks.append([*model.actor.parameters(), *model.critic.parameters()])
        explored.append(model.predict(OBSERVATIONS)[0])
    assert_same(*networks)
    np.testing.assert_array_equal(*explored)


@pytest.mark.parametrize("ema_decay", [None, 0.9])
def test_a_symmetric_driver_drives_both_ways_alike(ema_decay):
    """The mean of what the actor does on either side; to the bit before SB3 scales the actions."""
    model, plain = (
        make_model(init_std=0.5, ema_decay=ema_decay, symmetric=own) for own in (True, False)
    )
    seen = th.as_tensor(OBSERVATIONS)
    image = mirror_observations(seen, mirror_image(View()))
    for _ in range(2):
        driver, one_sided = model.policy.exact_driver(), plain.policy.exact_driver()
        assert th.equal(driver(image), mirror_actions(driver(seen)))
        assert not th.allclose(one_sided(image), mirror_actions(one_sided(seen)), atol=1e-3)
        mean = (one_sided(seen) + mirror_actions(one_sided(image))) / 2
        th.testing.assert_close(driver(seen), mean)
        expected = model.policy.unscale_action(driver(seen).numpy(force=True))
        found, _ = model.predict(OBSERVATIONS, deterministic=True)
        np.testing.assert_array_equal(found, expected)
        for each in (model, plain):
            each.set_random_seed(3)
            each.learn(20)


def test_switching_the_mode_reaches_every_module():
    """The short cut must not leave a module behind."""
    policy = make_model().policy
    for mode in (True, True, False, False, True):
        policy.set_training_mode(mode)
        assert {module.training for module in policy.actor.modules()} == {mode}
        assert {module.training for module in policy.critic.modules()} == {mode}
    assert {module.training for module in policy.actor_target.modules()} == {False}


# ------------------------------------------------------------------------------ lean updates


@pytest.mark.parametrize("kwargs", [{}, {"ema_decay": 0.9}, *ALIKE[1:]])
@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_lean_updates_learn_as_the_algorithm_does(algorithm, kwargs):
    """TD3's noise and delay, too; the same random numbers, and the same counts in the state."""
    states, logs = [], []
    for lean in (False, True):
        model = updater(SplitHeadPolicy, 32, algorithm, **{"net_arch": SMALL, **kwargs})
        train = LeanUpdates(model).train if lean else model.train
        for steps in (3, 7):
            train(steps, 32)
        states.append([
            model.policy.state_dict(),
            *(part.optimizer.state_dict() for part in (model.actor, model.critic)),
        ])  # fmt: skip
        logs.append({"updates": model._n_updates, **model.logger.name_to_value})
        states[-1].append(th.get_rng_state())
    th.testing.assert_close(*states, rtol=1e-5, atol=1e-5)
    assert logs[0] == pytest.approx(logs[1], rel=1e-5)


@pytest.mark.parametrize("n_critics", [1, 2, 3])
@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_one_core_learns_what_two_learn(monkeypatch, algorithm, n_critics):
    """To the bit; and so does the same seed once more."""
    found = []
    for cores in ({0}, {0, 1}, {0, 1}):
        monkeypatch.setattr(os, "sched_getaffinity", lambda process, cores=cores: cores)
        model = updater(
            SplitHeadPolicy, 32, algorithm, net_arch=SMALL, layer_norm=True, n_critics=n_critics
        )
        LeanUpdates(model).train(9, 32)
        found.append([
            model.policy.state_dict(), dict(model.logger.name_to_value),
            *(part.optimizer.state_dict() for part in (model.actor, model.critic)),
        ])  # fmt: skip
    th.testing.assert_close(found[0], found[1], rtol=0, atol=0)
    th.testing.assert_close(found[1], found[2], rtol=0, atol=0)


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_update_that_ends_early_leaves_no_thread_at_work(monkeypatch, error):
    """Whatever follows, as saving the model, sees critics that nobody writes to any more."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})
    model = updater(SplitHeadPolicy, 32, TD3, net_arch=SMALL)
    updates, begun = LeanUpdates(model), []
    learn = lean_updates._learn_values

    def slow(*args):
        begun.append(threading.current_thread())
        time.sleep(0.2 if begun[-1] is not threading.main_thread() else 0.0)
        learn(*args)
        begun.remove(threading.current_thread())

    def fail(*args):
        raise error

    monkeypatch.setattr(lean_updates, "_learn_values", slow)
    monkeypatch.setattr(updates, "_update_actor", fail)
    with pytest.raises(error):
        updates.train(2, 32)
    assert begun == []
    monkeypatch.undo()
    updates.train(2, 32)


def test_an_error_on_the_second_thread_is_told(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})
    updates = LeanUpdates(updater(SplitHeadPolicy, 32, TD3, net_arch=SMALL))
    learn = lean_updates._learn_values

    def fail(*args):
        if threading.current_thread() is not threading.main_thread():
            raise MemoryError("no room")
        learn(*args)

    monkeypatch.setattr(lean_updates, "_learn_values", fail)
    with pytest.raises(MemoryError, match="no room"):
        updates.train(1, 32)


def test_ctrl_c_loses_no_task_of_the_second_thread(monkeypatch):
    """It may come right after a task was begun, or in a wait for it; all are done at the end."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})
    done = []

    def slow(number):
        time.sleep(0.05)
        done.append(number)

    class Interrupted:
        def __init__(self, queue, calls):
            self.queue, self.calls = queue, calls

        def put(self, task):
            self.queue.put(task)
            self.calls -= 1
            if self.calls == 0:
                raise KeyboardInterrupt

    def use(calls):
        with two_threads() as other:
            other._tasks = Interrupted(other._tasks, calls)
            other.begin(partial(slow, calls))
            other.wait()
            raise KeyboardInterrupt

    for calls in (1, 2, 3):
        with pytest.raises(KeyboardInterrupt):
            use(calls)
        assert done[-1] == calls


def test_a_process_made_by_fork_has_a_second_thread_of_its_own(monkeypatch):
    """That of the parent does not run in it."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})

    def use():
        found = []
        with two_threads() as other:
            other.begin(lambda: found.append(threading.current_thread().name))
        assert found == ["update"]

    use()
    child = multiprocessing.get_context("fork").Process(target=use)
    child.start()
    child.join(30.0)
    assert child.exitcode == 0


def test_double_precision_learns_as_ever():
    """The replay buffer holds single precision, which the passes would have to convert."""
    model = make_model()
    assert is_for(model)
    model.policy.double()
    assert not is_for(model)


@pytest.mark.parametrize(("make", "found"), [
    (lambda: SAC("MlpPolicy", ToyRace(), buffer_size=10), "by SAC with SACPolicy"),
    (lambda: DDPG("MlpPolicy", ToyRace(), buffer_size=10), "by DDPG with TD3Policy"),
])  # fmt: skip
def test_a_model_without_the_policy_has_no_lean_updates(make, found):
    with pytest.raises(InvalidOption, match=found):
        make().learn(10, callback=LeanUpdatesCallback())


@pytest.mark.parametrize("kwargs", [
    {"activation_fn": nn.ELU}, {"optimizer_class": th.optim.SGD},
    {"optimizer_kwargs": {"amsgrad": True}}, {"features_extractor_class": Extractor},
])  # fmt: skip
def test_parts_that_lean_updates_do_not_know_learn_as_ever(kwargs):
    """The algorithm's own ``train`` goes on: to the bit what it is without the callback."""
    models = [make_model(**kwargs) for _ in range(2)]
    for model, callback in zip(models, (None, LeanUpdatesCallback()), strict=True):
        model.set_random_seed(1)
        model.learn(20, callback=callback)
        assert model._n_updates > 0
    assert_same(*(list(model.policy.parameters()) for model in models))


def test_the_parameters_are_given_back():
    """Each has numbers of its own after the training, and Adam goes on where it was."""
    model = make_model(ema_decay=0.9)
    model.learn(20, callback=LeanUpdatesCallback())
    for part in (model.actor, model.critic):
        for own in part.parameters():
            state = part.optimizer.state[own]
            assert state["step"] == model._n_updates
            for tensor in (own, state["exp_avg"], state["exp_avg_sq"]):
                assert tensor.is_contiguous()
                assert tensor.untyped_storage().nbytes() == 4 * tensor.numel()
    assert model.actor.mu.lean is None
    model.learn(10)


def test_a_copy_decides_without_the_model_that_learns():
    model = make_model()
    updates = LeanUpdates(model)
    assert deepcopy(model.actor.mu).lean is None
    seen = th.as_tensor(OBSERVATIONS)
    with th.no_grad():
        lean = model.actor.mu(seen)
        updates.release()
        th.testing.assert_close(model.actor.mu(seen), lean)


def test_a_model_is_a_stock_one_whenever_it_may_be_saved(tmp_path):
    """Between updates, in them (Ctrl-C comes then, as a rule), and after them."""
    model = make_model()
    found = []
    sample = model.replay_buffer.sample

    def noted(*args, **kwargs):
        found.append("train" in vars(model))
        return sample(*args, **kwargs)

    model.replay_buffer.sample = noted
    model.learn(20, callback=LeanUpdatesCallback())
    assert found == [False] * model._n_updates
    assert found
    assert "train" not in vars(model)


class Interrupt(BaseCallback):
    """Ctrl-C when a rollout has ended and its update has not begun."""

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        if self.n_calls >= 10:
            raise KeyboardInterrupt


def test_a_model_that_is_interrupted_before_an_update_is_saved(tmp_path):
    model = make_model()
    with pytest.raises(KeyboardInterrupt):
        model.learn(20, callback=[LeanUpdatesCallback(), Interrupt()])
    model.save(tmp_path / "model.zip")
    model = DDPG.load(tmp_path / "model.zip", DummyVecEnv([ToyRace]))
    assert not {"train", "_excluded_save_params"} & vars(model).keys()
    before = deepcopy(model.policy.state_dict())
    model.learn(20)
    after = model.policy.state_dict()
    assert any(not th.equal(own, after[name]) for name, own in before.items())


def test_gradient_steps_of_the_beginning_end_with_an_interrupted_training():
    model = make_model()
    change = GradientStepsCallback(gradient_steps=7, timesteps=100)
    with pytest.raises(KeyboardInterrupt):
        model.learn(20, callback=[change, Interrupt()])
    assert model.gradient_steps == 7
    end_changes(model)
    assert model.gradient_steps == 1
    assert "train" not in vars(model)


@pytest.mark.parametrize("space", [
    spaces.Box(-1.0, 1.0, (4, 3), np.float32), spaces.Box(-1.0, 1.0, (4,), np.float64),
    spaces.Discrete(5),
])  # fmt: skip
def test_observations_that_lean_updates_do_not_know_learn_as_ever(space):
    env = gym.wrappers.TransformObservation(ToyRace(), lambda _: space.sample(), space)
    model = DDPG(
        "SplitHeadPolicy", env, policy_kwargs={"net_arch": SMALL}, learning_starts=5, batch_size=8,
        buffer_size=500, device="cpu",
    )  # fmt: skip
    assert not is_for(model)
    model.learn(10, callback=LeanUpdatesCallback())


# ------------------------------------------------------------------------------ files


def test_a_copy_keeps_and_saves_the_state_of_its_optimizers(tmp_path):
    model = make_model(ema_decay=0.9)
    model.learn(20)
    other = deepcopy(model)
    for name in ("actor", "critic"):
        one, two = (getattr(each.policy, name).optimizer.state_dict() for each in (model, other))
        assert one["state"].keys() == two["state"].keys()
    other.save(tmp_path / "copy.zip")
    loaded = DDPG.load(tmp_path / "copy.zip")
    assert_same(list(loaded.policy.parameters()), list(model.policy.parameters()))


@pytest.mark.parametrize("lean", [False, True])
def test_the_same_seed_makes_the_same_model(lean):
    callback = LeanUpdatesCallback() if lean else None
    one, two = (make_model(n_critics=2, layer_norm=True, ema_decay=0.9) for _ in range(2))
    for model in (one, two):
        model.set_random_seed(1)
        model.learn(30, callback=callback)
    for a, b in zip(one.policy.parameters(), two.policy.parameters(), strict=True):
        assert th.equal(a, b)


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_a_loaded_model_goes_on_like_the_saved_one(tmp_path, algorithm):
    """Parameters, optimizer and its two rates: ten more updates end in the same bits."""
    kwargs = {"critic_lr_scale": 5.0, "layer_norm": True, "head_bias": (0, 0, -2)}
    model = make_model(algorithm, ema_decay=0.9, **kwargs)
    model.learn(20)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    loaded.set_logger(Logger(None, []))
    loaded.replay_buffer = model.replay_buffer
    for one in (model, loaded):
        one.set_random_seed(3)
        one.train(10, 8)
    assert_same(list(model.policy.parameters()), list(loaded.policy.parameters()))


def test_a_fresh_process_loads_it_without_importing_the_plugin(tmp_path):
    """The file names the class; nobody has to know the alias."""
    model = make_model()
    model.save(tmp_path / "model")
    np.save(tmp_path / "observations.npy", OBSERVATIONS)
    code = (
        "import sys, numpy as np; from stable_baselines3 import DDPG;"
        "model = DDPG.load(sys.argv[1] + '/model', device='cpu');"
        "np.save(sys.argv[1] + '/actions.npy', "
        "model.predict(np.load(sys.argv[1] + '/observations.npy'))[0])"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    expected = model.predict(OBSERVATIONS)[0]
    np.testing.assert_array_equal(np.load(tmp_path / "actions.npy"), expected)


def test_the_policy_alone_can_be_saved_and_loaded(tmp_path):
    """``policy.save`` and ``actor.save``, as for SB3's own."""
    kwargs = {"ema_decay": 0.9, "symmetric": True, "init_std": 0.5}
    policy = make_model(critic_lr_scale=2.0, head_bias=(0, 0, -1), **kwargs).policy
    for part in (policy, policy.actor):
        part.save(str(tmp_path / "part"))
        loaded = type(part).load(str(tmp_path / "part"), device="cpu")
        for known in (False, True) if part is policy else (False,):
            expected = policy.predict(OBSERVATIONS, deterministic=known)[0]
            found = loaded.predict(OBSERVATIONS, deterministic=known)[0]
            np.testing.assert_array_equal(found, expected)


def test_the_alias_belongs_to_ddpg_and_td3_only():
    """SB3's classes share a dictionary; ours must not leak into the others."""
    assert DDPG.policy_aliases["SplitHeadPolicy"] is SplitHeadPolicy
    assert TD3.policy_aliases["SplitHeadPolicy"] is SplitHeadPolicy
    assert "SplitHeadPolicy" not in PPO.policy_aliases
