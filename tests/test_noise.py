"""The noises: what they draw, on which policy, and what survives a pickle."""

from __future__ import annotations

import copy
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import VectorizedActionNoise

from sb3_torcs.errors import InvalidOption, NoiseNotBound
from sb3_torcs.noise import (
    BLOG,
    ActuatorNoise,
    OUNoise,
    OUParameters,
    SetPointNoise,
    StochasticBrake,
    bind,
    noises_of,
)

UNITS = np.array([1.0, 0.5, 0.5])  # environment units per unit of SB3's scaled action
ACTION_SPACE = spaces.Box(np.array([-1, 0, 0], np.float32), np.array([1, 1, 1], np.float32))


def bound(noise, n_envs: int = 1, learning_starts: int = 0) -> SimpleNamespace:
    """Make the least of a model around a noise; its actor returns its input."""
    noise = noise if n_envs == 1 else VectorizedActionNoise(noise, n_envs)
    model = SimpleNamespace(
        action_noise=noise,
        action_space=ACTION_SPACE,
        policy=SimpleNamespace(actor=th.nn.Identity()),
        num_timesteps=0,
        learning_starts=learning_starts,
    )
    bind(model)
    return model


def act(model: SimpleNamespace, *scaled: tuple[float, float, float]) -> np.ndarray:
    """Let the policy decide, and return the noise in environment units."""
    with th.no_grad():
        model.policy.actor(th.tensor(scaled))
    return model.action_noise() * UNITS


def draws(noise: ActuatorNoise, n: int) -> np.ndarray:
    """Return n draws (n, 3) in environment units."""
    return np.array([noise() for _ in range(n)]) * UNITS


# ------------------------------------------------------------------------------ set point


def test_set_point_without_chance_is_the_formula_of_the_original_code():
    """theta (mu - a) in environment units, for a policy at steering 0.5, throttle 0.75, brake 0."""
    noise = SetPointNoise(steering=[0, 0.6, 0], throttle=[0.5, 1, 0], brake=[-0.1, 1, 0])
    found = act(bound(noise), (0.5, 0.5, -1.0))
    np.testing.assert_allclose(found, [-0.3, -0.25, -0.1], rtol=1e-6)  # float32


def test_set_point_at_full_scale_drives_like_the_table_whatever_the_policy_says():
    """Throttle is 0.5 +- 0.1 and brake -0.1 +- 0.05: the statistics of the original code."""
    model = bound(SetPointNoise(seed=1))
    rng = np.random.default_rng(0)
    executed = []
    for scaled in rng.uniform(-1, 1, (4000, 3)):
        action = np.array([scaled[0], 0.5 * (scaled[1] + 1), 0.5 * (scaled[2] + 1)])
        executed.append(action + act(model, tuple(scaled)))
    throttle, brake = np.array(executed)[:, 1:].T
    # Four standard errors of 4000 draws.
    assert throttle.mean() == pytest.approx(0.5, abs=4 * 0.1 / 63)
    assert throttle.std() == pytest.approx(0.1, rel=4 / 89)
    assert brake.mean() == pytest.approx(-0.1, abs=4 * 0.05 / 63)
    assert brake.std() == pytest.approx(0.05, rel=4 / 89)


def test_each_environment_is_perturbed_by_its_own_action():
    """With two environments the second noise must not look at the first action."""
    noise = SetPointNoise(steering=[0, 1, 0], throttle=[0, 1, 0], brake=[0, 1, 0])
    found = act(bound(noise, n_envs=2), (0.5, 1.0, 0.0), (-0.5, 0.0, -1.0))
    np.testing.assert_array_equal(found, [[-0.5, -1.0, -0.5], [0.5, -0.5, 0.0]])


def test_updates_do_not_count_as_timesteps():
    """Updates call the actor with gradients, on other observations."""
    noise = SetPointNoise(steering=[0, 1, 0], throttle=[0, 1, 0], brake=[0, 1, 0])
    model = bound(noise)
    act(model, (0.5, 0.0, 0.0))
    model.policy.actor(th.full((8, 3), 0.9))
    np.testing.assert_array_equal(model.action_noise() * UNITS, [-0.5, -0.5, -0.5])


def test_set_point_without_a_policy_says_how_to_bind_it():
    """The error is a RuntimeError and names the callback."""
    with pytest.raises(NoiseNotBound, match="NoiseCallback") as caught:
        SetPointNoise()()
    assert isinstance(caught.value, RuntimeError)


def test_binding_twice_leaves_one_hook():
    """Each resume binds again."""
    model = bound(SetPointNoise())
    bind(model)
    assert len(model.policy.actor._forward_hooks) == 1


def test_binding_to_other_actuators_is_refused():
    """The units would be wrong without a word."""
    model = bound(SetPointNoise())
    model.action_space = spaces.Box(-1, 1, (3,))
    with pytest.raises(InvalidOption, match="steering, throttle and brake"):
        bind(model)


# ----------------------------------------------------------------------------- OU process


@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_ou_has_the_stationary_moments_and_the_correlation_of_the_process(dt):
    """Mean mu, variance sigma^2 / 2 theta, correlation exp(-theta dt): known answers."""
    theta, sigma = 0.6, 0.3
    steering = OUParameters(0.2, theta, sigma)
    x = draws(OUNoise(steering=steering, dt=dt, seed=3), 20_000)[100:, 0]
    deviation = x - x.mean()
    correlation = (deviation[1:] * deviation[:-1]).mean() / x.var()
    # The standard error of the mean grows with the correlation time; all within four of them.
    stationary = sigma / np.sqrt(2 * theta)
    independent = len(x) * np.tanh(theta * dt / 2)
    assert x.mean() == pytest.approx(0.2, abs=4 * stationary / np.sqrt(independent))
    assert x.std() == pytest.approx(stationary, rel=4 / np.sqrt(2 * independent))
    assert correlation == pytest.approx(np.exp(-theta * dt), abs=0.03)


def test_ou_without_chance_decays_exactly():
    """From the brake's override back to mu, by exp(-theta dt) per timestep."""
    noise = OUNoise(steering=[1, 0.5, 0], throttle=[0, 0.5, 0], brake=[0, 0.5, 0], dt=0.1)
    draws(noise, 1)
    noise.parameters = (OUParameters(0, 0.5, 0), *noise.parameters[1:])
    x = draws(noise, 3)[:, 0]
    np.testing.assert_allclose(x, np.exp([-0.05, -0.10, -0.15]), rtol=1e-6)  # float32


def test_ou_with_theta_zero_is_a_random_walk():
    """The limit: variance sigma^2 dt per timestep."""
    steps = np.diff(draws(OUNoise(steering=[0, 0, 0.3], dt=0.25, seed=0), 4000)[:, 0])
    assert steps.std() == pytest.approx(0.3 * 0.5, rel=4 / np.sqrt(2 * 4000))


def test_ou_begins_each_episode_at_mu():
    """The end of an episode must not leak into the next."""
    noise = OUNoise(steering=[0.3, 1, 0], throttle=[0, 1, 0], brake=[0, 1, 0])
    noise.parameters = (OUParameters(0, 1, 0), *noise.parameters[1:])
    noise._state = np.array([5.0, 0.0, 0.0])
    noise.reset()
    np.testing.assert_array_equal(draws(noise, 1), [[0, 0, 0]])


# -------------------------------------------------------------------------- what all share


def test_a_pedal_is_half_as_wide_as_sb3s_action():
    """Noise of x on a pedal is 2 x in SB3's scaled space, on the steering x."""
    noise = OUNoise(steering=[0.1, 1, 0], throttle=[0.1, 1, 0], brake=[0.1, 1, 0])
    np.testing.assert_array_equal(noise(), np.array([0.1, 0.2, 0.2], np.float32))


def test_nothing_is_added_while_sb3_acts_by_lot():
    """Before learning_starts the action is random already; timesteps count all the same."""
    model = bound(OUNoise(seed=0), learning_starts=10)
    np.testing.assert_array_equal(model.action_noise(), np.zeros(3))
    assert model.action_noise.timesteps == 1
    model.num_timesteps = 10
    assert model.action_noise().any()


def test_scale_multiplies_the_noise_exactly():
    whole, half = OUNoise(seed=5), OUNoise(seed=5)
    half.scale = 0.5
    np.testing.assert_array_equal(draws(half, 20), 0.5 * draws(whole, 20))


@pytest.mark.parametrize("cls", [OUNoise, SetPointNoise])
def test_same_seed_same_noise_and_the_global_generator_is_not_touched(cls):
    """Its own generator: nobody else's draws change it, and it changes nobody's."""
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    one, two = bound(cls(seed=7)), bound(cls(seed=7))
    for _ in range(20):
        np.testing.assert_array_equal(act(one, (0.1, 0.2, 0.3)), act(two, (0.1, 0.2, 0.3)))
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_parallel_environments_have_independent_streams():
    """SB3 makes them by deep copies, which must not draw the same numbers."""
    noise = VectorizedActionNoise(OUNoise(seed=0), 3)
    x = np.array([noise() for _ in range(2000)])[:, :, 0]
    off_diagonal = np.corrcoef(x.T)[np.triu_indices(3, 1)]
    assert np.abs(off_diagonal).max() < 0.15


@pytest.mark.parametrize("cls", [OUNoise, SetPointNoise])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_pickled_noise_goes_on_as_if_nothing_had_happened(cls, n_envs):
    """Generator, process, timesteps and scale; the binding is dropped."""
    actions = [(0.1, 0.2, 0.3)] * n_envs
    model = bound(cls(seed=2), n_envs)
    for noise in noises_of(model):
        noise.scale = 0.7
    for _ in range(5):
        act(model, *actions)
    twin = SimpleNamespace(**vars(model))
    twin.policy = SimpleNamespace(actor=th.nn.Identity())
    twin.action_noise = pickle.loads(pickle.dumps(model.action_noise))
    assert all(noise._watch is None for noise in noises_of(twin))
    bind(twin)
    for _ in range(5):
        np.testing.assert_array_equal(act(twin, *actions), act(model, *actions))
    assert noises_of(twin)[0].timesteps == noises_of(model)[0].timesteps == 10 * n_envs


def test_a_deep_copy_of_a_bound_noise_does_not_copy_the_model():
    """SB3 deep-copies noises; the model behind the binding is large and must not come along."""
    noise = bound(SetPointNoise(seed=0)).action_noise
    assert copy.deepcopy(noise)._watch is None
    assert noise._watch is not None


@pytest.mark.parametrize("cls", [OUNoise, SetPointNoise])
def test_stochastic_brake_comes_in_its_share_of_the_steps(cls):
    """10 % of the timesteps brake at 0.2 +- 0.1; the others hardly ever brake."""
    brake = OUParameters(-0.1, 50.0 if cls is OUNoise else 1.0, 0.0)
    other = OUParameters(0.2, brake.theta, 0.0)
    model = bound(cls(brake=brake, seed=0))
    model.action_noise.stochastic_brake = StochasticBrake(0.1, other)
    executed = np.array([act(model, (0.0, 0.0, -1.0))[2] for _ in range(4000)])
    # theta 50 forgets within a step, so both kinds alternate between the two set points.
    np.testing.assert_allclose(np.unique(executed.round(6)), [-0.1, 0.2])
    assert (executed > 0).mean() == pytest.approx(0.1, abs=4 * 0.3 / 63)


def test_a_saved_noise_has_no_stochastic_brake():
    """That is a callback's, which the training that goes on may not have."""
    noise = OUNoise(seed=0)
    noise.stochastic_brake = StochasticBrake(0.1, OUParameters(0.2, 1.0, 0.1))
    assert pickle.loads(pickle.dumps(noise)).stochastic_brake is None


def test_the_default_is_the_table_of_the_post():
    """Steering, throttle, brake: mu, theta, sigma."""
    assert OUNoise().parameters == BLOG == ((0.0, 0.6, 0.3), (0.5, 1.0, 0.1), (-0.1, 1.0, 0.05))


def test_parameters_come_as_a_list_or_as_a_mapping():
    """Both are what YAML can hold."""
    assert OUParameters.of([1, 2, 3]) == OUParameters.of({"mu": 1, "theta": 2, "sigma": 3})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        *[({"steering": steering}, r"\[mu, theta, sigma\]") for steering in
          ([1, 2], {"mu": 1, "theta": 2, "sgma": 3}, [0, -1, 0], [0, 1, -1], "abc", [0, 1, "x"])],
        *[({"dt": dt}, "dt=") for dt in (0.0, -1.0, np.inf, np.nan)],
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused(wrong, message):
    with pytest.raises(InvalidOption, match=message):
        OUNoise(**wrong)
