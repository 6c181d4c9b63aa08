"""Mirrored drives: what they are, that cars drive so, and the callback that learns from them."""

from __future__ import annotations

import gc
import weakref

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import car_state
from stable_baselines3 import DDPG, PPO, SAC
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from toy import ToyRace

from sb3_torcs.callbacks.replay import MirrorCallback
from sb3_torcs.errors import InvalidAction, InvalidOption
from sb3_torcs.policies.mirror import mirror_actions, mirror_half, mirror_image, mirror_observations
from sb3_torcs.policies.mirrored_replay import sample_mirrored
from sb3_torcs.sensors import View, encode, feature_slices
from sb3_torcs.vec_env import MirrorVecEnv, TorcsVecEnv

STRAIGHT = 4050.0  # [m] of forza, where nearly a kilometre of straight road begins
IMAGE = mirror_image(View())


def mirrored(observation):
    return mirror_observations(th.from_numpy(observation)[None], IMAGE)[0].numpy()


# ------------------------------------------------------------------------------ what is mirrored


def test_twice_mirrored_is_as_before():
    """So each number has its place, and each place one number."""
    observations = th.arange(58.0).reshape(2, 29)
    image = mirror_observations(observations, IMAGE)
    assert mirror_observations(image, IMAGE).equal(observations)
    assert not image.equal(observations)


def test_a_car_on_the_right_becomes_one_on_the_left():
    """All that has a side changes it; speed along the road and engine have none."""
    beams, wheels = np.arange(19.0), np.array([10.0, 20.0, 30.0, 40.0])
    right = car_state(
        heading_error=0.3, distance_from_axis=-2.0, speed_x=30.0, speed_y=1.5, speed_z=0.2,
        engine_speed=500.0, range_finders=beams, wheel_speeds=wheels,
    )  # fmt: skip
    left = right._replace(
        heading_error=-0.3, distance_from_axis=2.0, speed_y=-1.5,
        range_finders=beams[::-1], wheel_speeds=wheels[[1, 0, 3, 2]],
    )  # fmt: skip
    assert np.array_equal(mirrored(encode(right)), encode(left))


def test_steering_changes_sides_and_pedals_stay():
    actions = th.tensor([[0.5, 0.2, 0.1], [-1.0, -1.0, 1.0]])
    assert mirror_actions(actions).tolist() == th.tensor([[-0.5, 0.2, 0.1], [1, -1, 1]]).tolist()


@pytest.mark.parametrize("env_id", ["TorcsLite-v0", "Torcs-v0"])
def test_a_car_that_is_driven_mirrored_drives_mirrored(env_id):
    """On a straight, two seconds long; not to the bit, since sums have an order."""
    env = gym.make(env_id, track="forza", range_finders="narrow")
    drives = []
    for side in (1.0, -1.0):
        start = {"track_position": 0.2 * side, "heading_error": 0.03 * side, "speed": 40.0}
        env.reset(seed=0, options={"distance": STRAIGHT, **start})
        rows = []
        for step in range(20):
            action = np.array([side * 0.05 * np.sin(step / 3.0), 0.8, 0.0], np.float32)
            rows.append(env.step(action)[0])
        drives.append(np.array(rows))
    env.close()
    there, image = drives[0], np.array([mirrored(row) for row in drives[1]])
    beams = feature_slices()["range_finders"]
    near = there[:, beams] < 0.1  # others see the bend at the end
    np.testing.assert_allclose(image[:, beams][near], there[:, beams][near], atol=2e-4)
    rest = np.delete(np.arange(29), np.arange(29)[beams])
    np.testing.assert_allclose(image[:, rest], there[:, rest], atol=2e-4)
    assert np.abs(there[:, feature_slices()["speed_y"]]).max() > 1e-3  # it was steered


# ---------------------------------------------------------------------------------- the callback


class MirrorToy(ToyRace):
    """Range finders that look equally far to both sides."""

    range_finder_angles = np.linspace(-1.0, 1.0, 19)


class Batches(BaseCallback):
    """Draws a batch in each rollout, and notes those that were learned from."""

    def __init__(self) -> None:
        super().__init__()
        self.learned: list[th.Tensor] = []
        self.drawn: list[th.Tensor] = []

    def _on_training_start(self) -> None:
        self.critic = self.model.policy.critic
        self.handle = self.critic.register_forward_hook(
            lambda _module, inputs, _output: self.learned.append(inputs[0].clone())
        )

    def _on_step(self) -> bool:
        if self.model.replay_buffer.size():
            self.drawn.append(self.model.replay_buffer.sample(8).observations)
        return True


def make_model(algorithm=DDPG, env=MirrorToy, **kwargs):
    options = {"learning_starts": 8, "batch_size": 8, "buffer_size": 100, "seed": 0}
    return algorithm("MlpPolicy", make_vec_env(env), device="cpu", **{**options, **kwargs})


def known(rows, buffer):
    """Whether each row is an observation of the buffer."""
    held = buffer.observations[: buffer.size(), 0]
    return [bool((row.numpy() == held).all(axis=1).any()) for row in rows]


@pytest.mark.parametrize("options", [{}, {"n_steps": 3}, {"batch_size": 9}])
@pytest.mark.parametrize("algorithm", [DDPG, SAC])
def test_half_of_what_is_learned_from_is_mirrored(algorithm, options):
    """The buffer itself holds what was driven, and who draws from it elsewhere gets that."""
    model, batches = make_model(algorithm, **options), Batches()
    model.learn(12, callback=[MirrorCallback(), batches])
    buffer = model.replay_buffer
    size = options.get("batch_size", 8)
    half = size // 2
    assert batches.learned
    for batch in batches.learned:
        assert known(mirror_observations(batch[:half], IMAGE), buffer) == [True] * half
        assert known(batch, buffer) == [False] * half + [True] * (size - half)
    for batch in batches.drawn:
        assert all(known(batch, buffer))
    assert "sample" not in vars(buffer)


def test_all_of_a_transition_is_mirrored():
    """Its action and what came of it, too; reward, end and discount stay."""
    model = make_model(n_steps=2)
    model.learn(12)
    model.set_random_seed(0)
    stock = model.replay_buffer.sample(8)
    model.set_random_seed(0)
    batch = sample_mirrored(model.replay_buffer, 8)
    assert batch.actions[:4].equal(mirror_actions(stock.actions[:4]))
    image = mirror_observations(stock.next_observations[:4], IMAGE)
    assert batch.next_observations[:4].equal(image)
    for name in ("observations", "actions", "next_observations"):
        assert getattr(batch, name)[4:].equal(getattr(stock, name)[4:])
    for name in ("dones", "rewards", "discounts"):
        assert getattr(batch, name).equal(getattr(stock, name))


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("kind", ["stock", "a subclass"])
def test_batches_are_those_of_sb3_with_half_mirrored(n_steps, kind):
    """The same random numbers and the same bits, over ends, timeouts and the oldest transition."""
    rng = np.random.default_rng(n_steps)
    stock = NStepReplayBuffer if n_steps > 1 else ReplayBuffer
    buffer_class = stock if kind == "stock" else type("Own", (stock,), {})
    steps = {"n_steps": n_steps, "gamma": 0.97} if n_steps > 1 else {}
    env = make_vec_env(MirrorToy)
    spaces = env.observation_space, env.action_space
    buffer = buffer_class(60, *spaces, device="cpu", n_envs=2, **steps)
    for added in range(50):
        seen, then = rng.uniform(-1, 1, (2, 2, 29)).astype(np.float32)
        ends = rng.random((2, 2)) < 0.2
        infos = [{"TimeLimit.truncated": bool(end)} for end in ends[1]]
        buffer.add(
            seen, then, rng.uniform(-1, 1, (2, 3)), rng.uniform(-1, 1, 2), ends.any(0), infos
        )
        for seed in range(3 if added % 7 == 0 or buffer.full else 0):
            set_random_seed(seed)
            expected = mirror_half(buffer.sample(9), IMAGE)
            set_random_seed(seed)
            for one, two in zip(sample_mirrored(buffer, 9), expected, strict=True):
                assert (one is None and two is None) or one.equal(two)


def test_what_is_known_of_a_buffer_goes_with_it():
    """Drawing must not keep a buffer, of many megabytes as a rule."""
    model = make_model()
    model.learn(12)
    sample_mirrored(model.replay_buffer, 4)
    known = weakref.ref(model.replay_buffer)
    assert known() is not None
    model.replay_buffer = None
    gc.collect()
    assert known() is None


def test_a_buffer_that_is_saved_while_the_algorithm_learns_is_a_stock_one(tmp_path):
    """Ctrl-C comes then, as a rule, and what was driven is to be saved."""
    model = make_model(n_steps=3)
    model.learn(20)
    buffer = model.replay_buffer
    callback = MirrorCallback()
    callback.init_callback(model)
    callback.on_training_start({}, {})
    callback._change()
    model.save_replay_buffer(tmp_path / "replay.pkl")
    assert not all(known(buffer.sample(8).observations, buffer))
    model.load_replay_buffer(tmp_path / "replay.pkl")
    assert all(known(model.replay_buffer.sample(8).observations, buffer))


def test_what_has_no_mirror_image_is_told_at_once():
    """No replay buffer, statistics with a side, beams with a side, another world."""

    class OneSided(MirrorToy):
        range_finder_angles = np.linspace(-1.0, 0.5, 19)

    ppo = PPO("MlpPolicy", make_vec_env(MirrorToy), n_steps=8, batch_size=8, device="cpu")
    normalized = make_model(env=MirrorToy)
    normalized.set_env(VecNormalize(normalized.get_env()))
    stacked = DDPG("MlpPolicy", VecFrameStack(make_vec_env(MirrorToy), 2), device="cpu")
    for model, message in (
        (ppo, "PPO has none"),
        (normalized, "take 'normalize' away"),
        (make_model(env=OneSided), "pass 'scr' or 'narrow'"),
        (make_model(env=ToyRace), "has no range_finder_angles"),
        (stacked, "MirrorCallback: only observations of .* take out what changes their"),
    ):
        with pytest.raises(InvalidOption, match=message):
            model.learn(10, callback=MirrorCallback())


# ---------------------------------------------------------------------------- every other car


def test_every_other_car_drives_in_the_mirror():
    """Held to cars that are not mirrored and get the steering that is meant, to the bit."""
    options = {"env_id": "TorcsLite-v0", "start": "random", "range_finders": "narrow"}
    ours, theirs = MirrorVecEnv(TorcsVecEnv(4, **options)), TorcsVecEnv(4, **options)
    ours.seed(0), theirs.seed(0)
    rng, ends = np.random.default_rng(0), 0

    def image(observations):
        seen = observations.copy()
        for i in (1, 3):
            seen[i] = mirrored(observations[i])
        return seen

    assert np.array_equal(ours.reset(), image(theirs.reset()))
    for _ in range(100):
        asked = rng.uniform(-1.0, 1.0, (4, 3)).astype(np.float32)
        meant = asked * np.array([[1, 1, 1], [-1, 1, 1]] * 2, np.float32)
        given = asked.copy()
        seen, rewards, dones, infos = ours.step(given)
        others = theirs.step(meant)
        assert np.array_equal(given, asked)  # the caller's
        assert np.array_equal(seen, image(others[0]))
        assert np.array_equal(rewards, others[1])
        assert np.array_equal(dones, others[2])
        for i in np.flatnonzero(dones):
            last = others[3][i]["terminal_observation"]
            expected = mirrored(last) if i % 2 else last
            assert np.array_equal(infos[i]["terminal_observation"], expected)
            ends += i % 2
    assert ends


@pytest.mark.parametrize("sensors", [["base"], ["base", "line"]])
@pytest.mark.parametrize("frames", [2, 3, 4, 6])
def test_stacked_frames_are_not_taken_for_other_sensors(sensors, frames):
    """Three stacked observations have as many numbers as some choice of sensors."""
    cars = VecFrameStack(TorcsVecEnv(2, env_id="TorcsLite-v0", sensors=sensors), frames)
    with pytest.raises(InvalidOption, match="take out what changes their bounds or size"):
        MirrorVecEnv(cars)
    MirrorVecEnv(cars.venv).close()


def test_whole_numbers_drive_in_the_mirror_too():
    cars = MirrorVecEnv(TorcsVecEnv(2, env_id="TorcsLite-v0"))
    cars.reset()
    cars.step([[1, 1, 0], [1, 1, 0]])
    assert [car.steering for car in cars.get_attr("controls")] == [1.0, -1.0]
    with pytest.raises(InvalidAction, match=r"shape \(3,\); expected \(2, 3\)"):
        cars.step(np.zeros(3))
    cars.close()


ONE_SIDED = {"range_finders": list(range(-90, 5, 5))}


@pytest.mark.parametrize(("make", "message"), [
    (lambda: TorcsVecEnv(2, env_id="TorcsLite-v0", **ONE_SIDED), "needs range finders .* 'scr'"),
    (lambda: DummyVecEnv([lambda: gym.make("CartPole-v1")]), "have a known mirror image"),
    (lambda: gym.make("TorcsLite-v0"), "expected a vector environment"),
    (lambda: VecNormalize(TorcsVecEnv(2, env_id="TorcsLite-v0")), "VecNormalize.MirrorVecEnv"),
])  # fmt: skip
def test_what_has_no_mirror_image_is_not_mirrored(make, message):
    envs = make()
    with pytest.raises(InvalidOption, match=message):
        MirrorVecEnv(envs)
    envs.close()
