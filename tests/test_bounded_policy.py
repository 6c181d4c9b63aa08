"""A Gaussian policy whose mean cannot leave the action space."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn
from toy import ToyRace

from sb3_torcs.callbacks import LeanUpdatesCallback
from sb3_torcs.callbacks.adapting import AdaptiveLearningRateCallback, learn_values
from sb3_torcs.errors import InvalidOption
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.policies.mirror import mirror_actions, mirror_image, mirror_observations
from sb3_torcs.policies.ppo import is_for
from sb3_torcs.sensors import GROUPS, feature_slices

SEEN = np.random.default_rng(0).uniform(-1, 1, (50, 29)).astype(np.float32)


def make(n_steps=8, n_epochs=10, **policy_kwargs):
    kwargs = {"net_arch": [8], **policy_kwargs}
    rollouts = {"n_steps": n_steps, "batch_size": 8, "n_epochs": n_epochs}
    return PPO(BoundedPolicy, ToyRace(), policy_kwargs=kwargs, seed=0, **rollouts)


def drives(model, seen=SEEN):
    return model.predict(seen, deterministic=True)[0]


def loaded(model, folder):
    """The policy of a model, read from its file and from one of its own."""
    model.save(folder / "model.zip")
    model.policy.save(folder / "policy.pth")
    return PPO.load(folder / "model.zip").policy, BoundedPolicy.load(folder / "policy.pth")


def test_means_lie_within_the_action_space():
    """They reach its bounds, however large the outputs of the layer before are."""
    policy = make().policy
    low, high = policy.action_space.low, policy.action_space.high
    near = drives(policy)
    with th.no_grad():
        policy.action_net.linear.weight *= 1e5
    far = drives(policy)
    np.testing.assert_allclose(near, np.broadcast_to((low + high) / 2, (50, 3)), atol=0.05)
    assert np.all((far >= low) & (far <= high))
    assert set(far[:, 1].round(3)) == {0.0, 1.0}


def test_each_actuator_may_have_a_deviation_of_its_own():
    assert make(log_std_init=-1.0).policy.log_std.tolist() == [-1.0] * 3
    assert make(log_std_init=[-2.0, 0.0, 0.5]).policy.log_std.tolist() == [-2.0, 0.0, 0.5]
    for wrong in ([-2.0, 0.0], [[-1.0, -1.0, -1.0]]):
        with pytest.raises(InvalidOption, match=r"has shape .*; expected one number, or \(3,\)"):
            make(log_std_init=wrong)
    own = th.tensor([-2.0, 0.0, 0.5])
    assert make(log_std_init=own).policy.log_std.tolist() == own.tolist()
    for wrong in (np.nan, [0.0, 0.0, np.inf], 1000, "x", th.zeros(3) - 21.0):
        with pytest.raises(InvalidOption, match=r"log_std_init is .*; expected numbers from"):
            make(log_std_init=wrong)


@pytest.mark.parametrize("algorithm", [SAC, TD3, DDPG, RecurrentPPO])
def test_other_algorithms_are_told_their_policies(algorithm):
    with pytest.raises(InvalidOption, match="a policy of PPO and A2C; give DDPG and TD3 SplitHead"):
        algorithm(BoundedPolicy, ToyRace())
    assert not hasattr(make().policy, "actor")


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_algorithms_know_it_by_name(algorithm):
    model = algorithm("BoundedPolicy", ToyRace(), n_steps=64)
    assert type(model.learn(20).policy) is BoundedPolicy


@pytest.mark.parametrize(("net_arch", "message"), [
    *[(sizes, "is no layer size; pass whole numbers >= 1")
      for sizes in ([0, 8], [8.5], {"pi": [8], "vf": ["8"]})],
    *[(sizes, r"is no list of layer sizes; pass e\.g\. net_arch=")
      for sizes in (5, 0, {"pi": 5, "vf": [8]})],
])  # fmt: skip
def test_layers_are_a_list_of_whole_sizes(net_arch, message):
    with pytest.raises(InvalidOption, match=message):
        make(net_arch=net_arch)


def test_a_saved_model_decides_as_before(tmp_path):
    model = make(log_std_init=[-2.0, 0.0, 0.5])
    model.save(tmp_path / "model.zip")
    model.policy.save(tmp_path / "policy.pth")
    loaded = PPO.load(tmp_path / "model.zip")
    assert BoundedPolicy.load(tmp_path / "policy.pth").log_std_init == [-2.0, 0.0, 0.5]
    observation = np.full(29, 0.3, np.float32)
    for deterministic in (True, False):
        actions = []
        for each in (model, loaded):
            th.manual_seed(0)
            actions.append(each.predict(observation, deterministic=deterministic)[0])
        np.testing.assert_array_equal(*actions)


def test_what_it_cannot_bound_is_refused():
    with pytest.raises(InvalidOption, match="use MlpPolicy"):
        PPO(BoundedPolicy, gym.make("CartPole-v1"))
    with pytest.raises(InvalidOption, match="has no use_sde"):
        PPO(BoundedPolicy, ToyRace(), use_sde=True)


def test_who_rounds_otherwise_drives_the_same():
    """
    A product of another size is added up in another order, as on another processor.

    So the means of SB3's own network depend on how many it is asked for at once.
    """
    policy = make(net_arch=[128, 128]).policy
    with th.no_grad():
        policy.action_net.linear.weight *= 100.0
    seen = np.random.default_rng(0).uniform(-1, 1, (2000, 29)).astype(np.float32)
    alone = np.concatenate([policy.predict(row[None], deterministic=True)[0] for row in seen])
    np.testing.assert_array_equal(alone, policy.predict(seen, deterministic=True)[0])
    with th.no_grad():
        plain = policy.get_distribution(th.as_tensor(seen)).mode().numpy()
    assert np.any(plain != alone)
    np.testing.assert_allclose(plain, alone, atol=1e-5)


@pytest.mark.parametrize("callbacks", [[], [LeanUpdatesCallback()]])
def test_what_drives_follows_the_training(callbacks):
    model = make(activation_fn=nn.ReLU)
    driven = []
    for _ in range(3):
        model.learn(8, callback=callbacks, reset_num_timesteps=False)
        driven.append(drives(model))
        with th.no_grad():
            mean = model.policy.get_distribution(th.as_tensor(SEEN)).mode().numpy()
        np.testing.assert_allclose(driven[-1], mean, atol=1e-6)
    assert np.any(driven[0] != driven[1])
    assert np.any(driven[1] != driven[2])


SEES = ["base", "preview", "motion"]


def make_asymmetric(**policy_kwargs):
    env = gym.make("TorcsLite-v0", sensors=SEES)
    kwargs = {"activation_fn": nn.ReLU, "net_arch": [8], "actor_sensors": ["base"], **policy_kwargs}
    with pytest.warns(UserWarning, match="truncated mini-batch"):
        model = PPO(BoundedPolicy, env, policy_kwargs=kwargs, n_steps=40, batch_size=16, seed=0)
    model.observation_space.seed(0)
    return model


@pytest.mark.parametrize(
    ("actor_sensors", "names"),
    [(["base"], ["base"]), (("motion", "base"), ["base", "motion"]), (SEES, SEES)],
)
def test_an_actor_may_see_less_than_its_value_function(actor_sensors, names, tmp_path):
    """Whatever the other numbers are, it does the same; and what it learned tells the values."""
    model = make_asymmetric(actor_sensors=actor_sensors)
    model.learn(40)
    where = feature_slices(SEES)
    chosen = {sensor.name for name in names for sensor in GROUPS[name]}
    first, second = (model.observation_space.sample() for _ in range(2))
    for name in chosen:
        second[where[name]] = first[where[name]]
    for policy in (model.policy, *loaded(model, tmp_path)):
        assert policy.actor_sensors == tuple(names)
        actions = [policy.predict(seen, deterministic=True)[0] for seen in (first, second)]
        np.testing.assert_array_equal(*actions)
        both = th.as_tensor(np.stack((first, second)))
        with th.no_grad():
            means, values = policy.get_distribution(both).mode(), policy.predict_values(both)
        # Rows of one product are added up in different orders: equal but for the last digits.
        assert means[0].allclose(means[1], atol=1e-5)
        assert values[0].allclose(values[1], atol=1e-5) is (names == SEES)


SCALE = {"range_finders": 3.0, "heading_error": 0.2, "bends_ahead": 0.1}


@pytest.mark.parametrize("own", [{}, {"symmetric": True, "ema_decay": 0.9, "input_scale": SCALE}])
@pytest.mark.parametrize("net_arch", [[8], {"pi": [6, 5], "vf": [8]}, []])
def test_lean_updates_of_an_asymmetric_policy_learn_as_ppo_does(net_arch, own):
    states = []
    for callback in (None, LeanUpdatesCallback()):
        model = make_asymmetric(net_arch=net_arch, **own)
        assert is_for(model) is (net_arch != [])
        model.learn(80, callback=callback)
        states.append(model.policy.state_dict())
    th.testing.assert_close(*states, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("actor_sensors", [None, ["base"]])
@pytest.mark.parametrize("net_arch", [[8], []])
def test_a_symmetric_policy_drives_and_values_both_ways_alike(actor_sensors, net_arch, tmp_path):
    """The mean of what the same networks alone say of an observation and of its mirror image."""
    model, plain = (
        make_asymmetric(actor_sensors=actor_sensors, net_arch=net_arch, symmetric=symmetric)
        for symmetric in (True, False)
    )
    model.learn(40)
    plain.policy.load_state_dict(model.policy.state_dict())
    space, rng = model.observation_space, np.random.default_rng(0)
    seen = th.as_tensor(rng.uniform(space.low, space.high, (50, *space.shape)).astype(np.float32))
    image = mirror_observations(seen, mirror_image(space))
    with th.no_grad():
        one, other = (plain.policy.get_distribution(way).mode() for way in (seen, image))
        values = [plain.policy.predict_values(way) for way in (seen, image)]
        for policy in (model.policy, *loaded(model, tmp_path)):
            mean = policy.get_distribution(seen).mode()
            th.testing.assert_close(mean, 0.5 * (one + mirror_actions(other)))
            th.testing.assert_close(policy.predict_values(seen), 0.5 * (values[0] + values[1]))
            driver = policy.exact_driver()
            assert th.equal(driver(image), mirror_actions(driver(seen)))
            th.testing.assert_close(driver(seen), mean, rtol=0.0, atol=1e-5)
    assert not th.allclose(one, mirror_actions(other), atol=1e-3)


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize(("actor_sensors", "seen"), [(None, SEES), (["base"], ["base"])])
def test_both_networks_see_scaled_inputs(actor_sensors, seen, symmetric, tmp_path):
    """As if the weights of their first layers had the factors instead."""
    model, plain = (
        make_asymmetric(actor_sensors=actor_sensors, symmetric=symmetric, **own)
        for own in ({"input_scale": SCALE}, {})
    )
    model.learn(40)
    weights = {name: own.clone() for name, own in model.policy.state_dict().items()}
    for net, groups in (("policy_net", seen), ("value_net", SEES)):
        where = feature_slices(groups)
        for sensor in SCALE.keys() & where.keys():
            weights[f"mlp_extractor.{net}.0.weight"][:, where[sensor]] *= SCALE[sensor]
    plain.policy.load_state_dict(weights)
    some = th.as_tensor(np.stack([model.observation_space.sample() for _ in range(50)]))
    with th.no_grad():
        expected = plain.policy.get_distribution(some).mode(), plain.policy.predict_values(some)
        for policy in loaded(model, tmp_path):
            assert policy.input_scale == SCALE
            found = policy.get_distribution(some).mode(), policy.predict_values(some)
            th.testing.assert_close(found, expected)
            th.testing.assert_close(policy.exact_driver()(some), expected[0], rtol=0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"wheel_speed": 0.3}, "names 'wheel_speed'; did you mean 'wheel_speeds'"),
        ({"base": 0.3}, "names 'base'.* pass factors by the names of sensors, e.g."),
        ({"wheel_speeds": 0.0}, r"={'wheel_speeds': 0.0}: a factor is a number above 0"),
        ({"wheel_speeds": "3"}, "a factor is a number above 0"),
        ({3: 0.3}, "names 3; pass factors"),
        ([0.3], r"input_scale=\[0.3\]; pass factors"),
    ],
)
def test_a_scale_that_is_none_is_told(wrong, message):
    with pytest.raises(InvalidOption, match=message):
        make(input_scale=wrong)


@pytest.mark.parametrize(
    "chosen",
    [
        {"input_scale": SCALE},
        {"actor_sensors": ["base"]},
        {"actor_sensors": ["base"], "input_scale": SCALE},
    ],
)
def test_features_cannot_be_extracted_otherwise_from_chosen_numbers(chosen):
    class Twice(FlattenExtractor):
        def forward(self, observations):
            return 2.0 * super().forward(observations)

    options = " and ".join(chosen)
    chosen = {"actor_sensors": None, **chosen}
    make_asymmetric(features_extractor_class=Twice, actor_sensors=None)
    with pytest.raises(InvalidOption, match=f"Twice'> with {options}: .*, or {options}, which"):
        make_asymmetric(features_extractor_class=Twice, **chosen)
    make_asymmetric(features_extractor_class=FlattenExtractor, **chosen)


@pytest.mark.parametrize("callbacks", [[], [LeanUpdatesCallback()]])
def test_the_average_of_the_weights_drives(callbacks, tmp_path):
    """It begins with those of the first update, and training is the same without it."""
    kwargs = {"n_epochs": 1, "activation_fn": nn.ReLU}
    model, plain = make(**kwargs, ema_decay=0.75), make(**kwargs)
    expected = []
    for _ in range(3):
        for each in (model, plain):
            each.set_random_seed(3)
            each.learn(8, callback=callbacks, reset_num_timesteps=False)
        learned = [*plain.policy.mlp_extractor.policy_net.parameters()]
        learned += plain.policy.action_net.parameters()
        pairs = zip(expected or learned, learned, strict=True)
        expected = [(0.75 * old + 0.25 * new).detach() for old, new in pairs]
    th.testing.assert_close([*model.policy.average.module.parameters()], expected)
    states = {**model.policy.state_dict()}
    for name, own in plain.policy.state_dict().items():
        assert th.equal(states[name], own)
    model.save(tmp_path / "model.zip")
    found = [drives(each) for each in (model, PPO.load(tmp_path / "model.zip"), plain)]
    np.testing.assert_array_equal(*found[:2])
    assert np.any(found[1] != found[2])


def test_before_its_first_update_an_average_leaves_the_driving_to_the_actor(tmp_path):
    """Weights of a policy without one may be loaded; and where only values learn, it learns not."""
    plain, model = make(activation_fn=nn.ReLU), make(activation_fn=nn.ReLU, ema_decay=0.999)
    plain.save(tmp_path / "plain.zip")
    drives(model)
    model.set_parameters(tmp_path / "plain.zip", exact_match=False)
    np.testing.assert_array_equal(drives(model), drives(plain))
    learn_values(model, 32)
    np.testing.assert_array_equal(drives(model), drives(plain))
    model.learn(8)
    assert np.any(drives(model) != drives(plain))


def test_after_its_values_a_model_learns_by_the_rate_that_is_asked_for():
    model = make(activation_fn=nn.ReLU)
    learn_values(model, 64)
    rate = AdaptiveLearningRateCallback(first_factor=0.1)
    rate.init_callback(model)
    assert rate.factor == 0.1
    assert not model.policy.optimizer.state


@pytest.mark.parametrize("change", ["vector", "data"])
def test_a_policy_drives_by_values_that_it_has_just_got(change):
    """As evolution strategies set them."""
    model = make()
    seen = np.zeros(29, np.float32)
    first, _ = model.predict(seen, deterministic=True)
    vector = model.policy.parameters_to_vector() + 0.3
    if change == "vector":
        model.policy.load_from_vector(vector)
    else:
        for own in model.policy.parameters():
            own.data = own.data + 0.3
    expected = model.policy.exact_driver()(th.zeros(1, 29)).detach().numpy()[0]
    found, _ = model.predict(seen, deterministic=True)
    np.testing.assert_array_equal(found, expected)
    assert np.any(found != first)


def test_a_policy_with_an_average_can_be_pickled():
    model = make(ema_decay=0.9)
    model.learn(8)
    other = pickle.loads(pickle.dumps(model.policy))
    np.testing.assert_array_equal(drives(other), drives(model.policy))


def test_the_average_of_a_copy_follows_the_copy():
    model = make(ema_decay=0.9, n_epochs=2)
    first = model.policy
    model.policy = copy.deepcopy(first)
    model.learn(16)
    assert (first.average.n_averaged, model.policy.average.n_averaged) == (0, 4)
    trained = zip(model.policy.average.parameters(), first.average.parameters(), strict=True)
    assert not all(own.equal(other) for own, other in trained)


def test_who_has_no_mirror_image_has_no_symmetric_policy():
    with pytest.raises(InvalidOption, match=r"of shape \(3,\), .* pass symmetric=False"):
        PPO(BoundedPolicy, gym.make("Pendulum-v1"), policy_kwargs={"symmetric": True})
    for wrong, message in (({"symmetric": "no"}, "expected True or False"),
                           ({"ema_decay": 1.0}, r"pass a share in \[0, 1\)")):  # fmt: skip
        with pytest.raises(InvalidOption, match=message):
            make(**wrong)


def test_an_actor_cannot_see_what_the_environment_does_not_give():
    with pytest.raises(InvalidOption, match=r"the environment gives \['base', 'preview', 'motion'"):
        make_asymmetric(actor_sensors=["base", "line"])
    for wrong in ("base", ["line"], ["base", "base"], 3):
        with pytest.raises(InvalidOption, match=r"actor_sensors is .* expected a list with 'base'"):
            make_asymmetric(actor_sensors=wrong)
    with pytest.raises(InvalidOption, match="take out what changes their bounds or size"):
        PPO(BoundedPolicy, gym.make("Pendulum-v1"), policy_kwargs={"actor_sensors": ["base"]})
    with pytest.raises(InvalidOption, match=r"input_scale: these .*, or leave input_scale out"):
        PPO(BoundedPolicy, gym.make("Pendulum-v1"), policy_kwargs={"input_scale": SCALE})
