"""The callbacks on a toy race: installed noise, its decay and brake, reward and start."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3 import DDPG, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan
from toy import ToyRace

from sb3_torcs.callbacks import (
    NoiseCallback,
    NoiseDecayCallback,
    RandomStartCallback,
    RewardCallback,
    StochasticBrakeCallback,
)
from sb3_torcs.callbacks.replay import GradientStepsCallback, MirrorCallback
from sb3_torcs.errors import InvalidOption, Sb3TorcsError
from sb3_torcs.noise import ActuatorNoise, OUNoise, SetPointNoise, noises_of

SET_POINT = {"steering": [0, 1, 0], "throttle": [0.5, 1, 0], "brake": [-0.1, 1, 0]}


class Spy(BaseCallback):
    """Notes the noise's scale, the actions, the infos and the logged values of every timestep."""

    def __init__(self) -> None:
        super().__init__()
        self.scales: list[float] = []
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []
        self.starts: list[str] = []
        self.logged: dict[str, float] = {}
        self.settings: list[tuple[str, str]] = []

    def _on_step(self) -> bool:
        self.scales += [noise.scale for noise in noises_of(self.model)[:1]]
        self.actions += [*self.locals["actions"]]
        self.rewards += [*self.locals["rewards"]]
        self.starts += [info["start"] for info in self.locals["infos"]]
        self.logged = dict(self.logger.name_to_value)
        self.settings = self.training_env.env_method("settings")
        return True


def make_model(n_envs: int = 1, vec_env_cls=DummyVecEnv, algorithm=DDPG, **kwargs):
    env = make_vec_env(ToyRace, n_envs=n_envs, vec_env_cls=vec_env_cls, seed=0)
    options = {"learning_starts": 0, "gradient_steps": 0, "buffer_size": 1000, "seed": 0}
    model = algorithm(
        "MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", **{**options, **kwargs}
    )
    model.set_logger(Logger(None, []))
    return model


def learn(model, steps: int, *callbacks: BaseCallback) -> Spy:
    spy = Spy()
    model.learn(steps, callback=[*callbacks, spy], log_interval=10_000)
    return spy


# ---------------------------------------------------------------------------------- noise


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(("kind", "cls"), [("set_point", SetPointNoise), ("ou", OUNoise)])
def test_noise_callback_installs_one_noise_per_environment(kind, cls, n_envs):
    """YAML of stock rl_zoo3 cannot name a noise; the callback brings it."""
    model = make_model(n_envs)
    learn(model, 12, NoiseCallback(kind=kind))
    assert [type(noise) for noise in noises_of(model)] == [cls] * n_envs
    assert isinstance(model.action_noise, VectorizedActionNoise) is (n_envs > 1)
    assert [noise.timesteps for noise in noises_of(model)] == [12] * n_envs


@pytest.mark.parametrize(("n_envs", "algorithm"), [(1, DDPG), (3, DDPG), (1, SAC)])
def test_full_set_point_noise_drives_the_car_by_the_table(n_envs, algorithm):
    """
    At scale 1, theta 1 and no chance the executed action is mu, clipped, in every world.

    The buffer holds it as SB3 scales it: 0.5 on the throttle is 0 there, no brake is -1.
    """
    model = make_model(n_envs, algorithm=algorithm)
    spy = learn(model, 30, NoiseCallback(**SET_POINT))
    np.testing.assert_allclose(spy.actions, [[0.0, 0.5, 0.0]] * len(spy.actions), atol=1e-6)
    np.testing.assert_allclose(model.replay_buffer.actions[:10, 0], [[0, 0, -1]] * 10, atol=1e-6)


def test_evaluation_in_between_does_not_disturb_the_set_point():
    """EvalCallback uses the same actor, on other observations."""
    model = make_model(train_freq=1, gradient_steps=1, batch_size=4)
    env = DummyVecEnv([ToyRace])
    evaluation = EvalCallback(env, eval_freq=3, n_eval_episodes=1, verbose=0, warn=False)
    spy = learn(model, 20, NoiseCallback(**SET_POINT), evaluation)
    np.testing.assert_allclose(spy.actions, [[0.0, 0.5, 0.0]] * 20, atol=1e-6)


@pytest.mark.parametrize("kind", ["set_point", "ou"])
def test_same_seed_same_training(kind):
    """The noise's seed is the model's if none is given."""
    one, two = (learn(make_model(2), 20, NoiseCallback(kind=kind)) for _ in range(2))
    np.testing.assert_array_equal(one.actions, two.actions)


def test_the_seed_of_the_callback_comes_first():
    one, two = (learn(make_model(), 5, NoiseCallback(kind="ou", seed=seed)) for seed in (1, 2))
    assert not np.array_equal(one.actions, two.actions)


def test_nothing_is_added_during_the_warm_up():
    """Before learning_starts SB3 samples; the set point must not pull those actions."""
    model = make_model(learning_starts=8)
    spy = learn(model, 10, NoiseCallback(**SET_POINT))
    assert np.ptp(np.array(spy.actions)[:8], axis=0).min() > 0.3
    np.testing.assert_allclose(spy.actions[8:], [[0.0, 0.5, 0.0]] * 2, atol=1e-6)


@pytest.mark.parametrize(("before", "after"), [(1, 1), (4, 4), (1, 4), (4, 1), (4, 2)])
@pytest.mark.parametrize("kind", ["set_point", "ou"])
def test_a_resumed_model_goes_on_with_its_noise(tmp_path, kind, before, after):
    """Count and scale survive save and load, also with another number of environments."""
    callbacks = [NoiseCallback(kind=kind), NoiseDecayCallback(timesteps=100)]
    model = make_model(before)
    learn(model, 40, *callbacks)
    model.save(tmp_path / "model")
    env = make_vec_env(ToyRace, n_envs=after, seed=0)
    resumed = DDPG.load(tmp_path / "model", env=env, device="cpu")
    resumed.set_logger(Logger(None, []))
    spy = learn(resumed, 20, *callbacks)
    assert [noise.timesteps for noise in noises_of(resumed)] == [60] * after
    assert spy.scales[0] == 1.0 - (40 + after) / 100
    streams = {noise._rng.random() for noise in noises_of(resumed)}
    assert len(streams) == after


def test_a_resumed_noise_takes_the_new_parameters():
    """The hyperparameter file of the second run is what counts."""
    model = make_model()
    learn(model, 5, NoiseCallback(kind="ou", steering=[0, 1, 0.1], dt=0.5))
    noise = model.action_noise
    learn(model, 5, NoiseCallback(kind="ou", steering=[0, 1, 0.9], dt=0.2))
    assert model.action_noise is noise
    assert (noise.parameters[0].sigma, noise.dt, noise.timesteps) == (0.9, 0.2, 10)


def test_another_kind_continues_the_count_of_timesteps():
    """The decay goes on; no hook of the old noise stays on the actor."""
    model = make_model()
    learn(model, 5, NoiseCallback(kind="set_point"))
    learn(model, 5, NoiseCallback(kind="ou"))
    assert type(model.action_noise) is OUNoise
    assert model.action_noise.timesteps == 10
    assert len(model.actor._forward_hooks) == 1


def test_a_foreign_noise_is_replaced():
    model = make_model(action_noise=NormalActionNoise(np.zeros(3), np.ones(3)))
    learn(model, 3, NoiseCallback(kind="ou"))
    assert isinstance(model.action_noise, OUNoise)


def test_an_algorithm_without_action_noise_is_refused():
    model = PPO("MlpPolicy", DummyVecEnv([ToyRace]), n_steps=8, batch_size=8, device="cpu")
    for callback in (NoiseCallback, NoiseDecayCallback, StochasticBrakeCallback):
        told = f"PPO takes no action noise; use {callback.__name__} with DDPG, TD3 or SAC"
        with pytest.raises(InvalidOption, match=told):
            model.learn(8, callback=callback())


# ----------------------------------------------------------------------- decay and brake


@pytest.mark.parametrize("n_envs", [1, 2])
def test_decay_is_linear_down_to_the_floor(n_envs):
    """1 - 0.8 k/20 after k timesteps, then 0.2 for ever; every environment counts."""
    decay = NoiseDecayCallback(timesteps=20, floor=0.2)
    spy = learn(make_model(n_envs), 30, decay, NoiseCallback(kind="ou"))
    timesteps = np.arange(n_envs, 31, n_envs)
    expected = [1.0 - (1.0 - 0.2) * min(k / 20, 1.0) for k in timesteps]
    np.testing.assert_array_equal(spy.scales, expected)
    assert spy.logged["noise/scale"] == pytest.approx(0.2)
    assert spy.logged["noise/timesteps"] == 30


def test_decay_counts_for_a_noise_that_came_with_the_model():
    """Without NoiseCallback: SB3 copies the noise for two environments, timesteps count double."""
    model = make_model(2, action_noise=OUNoise(seed=0))
    learn(model, 20, NoiseDecayCallback(timesteps=40))
    assert [noise.timesteps for noise in noises_of(model)] == [20, 20]
    assert [noise.scale for noise in noises_of(model)] == [0.5, 0.5]


@pytest.mark.parametrize("callback", [NoiseDecayCallback, StochasticBrakeCallback])
def test_steering_a_noise_that_is_not_there_is_an_error(callback):
    """It names the callback that is missing."""
    with pytest.raises(InvalidOption, match="add NoiseCallback"):
        learn(make_model(), 2, callback())


@pytest.mark.parametrize("kind", ["set_point", "ou"])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_stochastic_brake_overrides_its_share_of_the_timesteps(kind, n_envs):
    """With probability 1 each timestep pulls to its mu; afterwards the noise is as before."""
    brake = [0, 1, 0]
    noise = NoiseCallback(kind=kind, brake=brake)
    always = StochasticBrakeCallback(probability=1.0, mu=0.9, theta=1.0, sigma=0.0)
    model = make_model(n_envs)
    spy = learn(model, 10, always, noise)
    assert np.array(spy.actions)[:, 2].min() > 0.8
    assert all(noise.stochastic_brake is None for noise in noises_of(model))


class Raising(BaseCallback):
    """Ends a training when its first rollout is over."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        raise KeyboardInterrupt


def test_a_brake_that_an_error_left_on_is_off_in_a_training_without_it():
    model = make_model()
    with pytest.raises(KeyboardInterrupt):
        learn(model, 4, NoiseCallback(), StochasticBrakeCallback(), Raising())
    assert noises_of(model)[0].stochastic_brake is not None
    learn(model, 4, NoiseCallback())
    assert noises_of(model)[0].stochastic_brake is None


def test_the_brake_of_the_post_brakes_in_every_tenth_timestep():
    """mu 0.2 +- 0.1 in 10 % of the timesteps: above 5 % brake in 9.3 %, else in hardly any."""
    model = make_model()
    spy = learn(model, 1500, NoiseCallback(seed=3), StochasticBrakeCallback())
    brake = np.array(spy.actions)[:, 2]
    share = (brake > 0.05).mean()
    # 10 % times P(N > -1.5) = 93 %, and 0.13 % of the other timesteps; four standard errors.
    assert share == pytest.approx(0.0945, abs=4 * np.sqrt(0.0945 * 0.9055 / 1500))


# ----------------------------------------------------------------------- reward and start


@pytest.mark.parametrize(
    ("n_envs", "kind"), [(1, DummyVecEnv), (2, DummyVecEnv), (2, SubprocVecEnv)]
)
def test_reward_and_start_are_switched_and_given_back(n_envs, kind):
    """Through Monitor, in one process and in several; each environment gets back its own."""
    model = make_model(n_envs, kind)
    env = model.get_env()
    env.env_method("set_reward", "ab", indices=[0])
    before = env.env_method("settings")
    spy = learn(model, 40, RewardCallback(reward="blog"), RandomStartCallback())
    assert spy.settings == [("blog", "random")] * n_envs
    assert spy.rewards == [4.0] * 40
    assert set(spy.starts) == {"random"}
    assert model.replay_buffer.rewards[: 40 // n_envs].tolist() == [[4.0] * n_envs] * (40 // n_envs)
    assert model.ep_info_buffer[-1]["r"] == 40.0
    assert env.env_method("settings") == before
    env.close()


def test_what_an_interrupted_training_left_is_not_taken_for_the_environments_own():
    """SB3 tells no callback that an exception has ended a training."""
    model = make_model()
    before = model.get_env().env_method("settings")
    callbacks = [RewardCallback(reward="blog"), RandomStartCallback()]
    with pytest.raises(KeyboardInterrupt):
        learn(model, 4, *callbacks, Raising())
    learn(model, 4, *callbacks)
    assert model.get_env().env_method("settings") == before


@pytest.mark.parametrize("wrapped", [False, True])
def test_of_several_callbacks_of_a_kind_none_takes_the_setting_of_another_for_the_own(wrapped):
    """Whichever is undone last, also where an evaluation has the training's environments."""
    model = make_model()
    env = model.get_env()
    if wrapped:
        model.set_env(VecCheckNan(env))
    evaluation = EvalCallback(VecCheckNan(env) if wrapped else env, eval_freq=1000, verbose=0)
    callbacks = [
        RewardCallback(reward="blog", also_eval=True),
        RewardCallback(reward="apex", timesteps=4),
        RandomStartCallback(),
        RandomStartCallback(),
        evaluation,
    ]
    for _ in range(2):
        assert learn(model, 8, *callbacks).settings == [("apex", "random")]
        assert env.env_method("settings") == [("progress", "grid")]


def test_an_environment_that_is_in_two_vectors_gets_back_its_own_reward():
    """SB3 makes a vector of it for the training, and one for the evaluation."""
    model, race = make_model(), ToyRace()
    model.set_env(DummyVecEnv([lambda: race]))
    evaluation = EvalCallback(DummyVecEnv([lambda: race]), eval_freq=1000, warn=False, verbose=0)
    learn(model, 4, RewardCallback(reward="blog", also_eval=True), evaluation)
    assert race.settings() == ("progress", "grid")


def test_the_reward_changes_after_so_many_timesteps():
    model = make_model()
    spy = learn(model, 20, RewardCallback(reward="blog", timesteps=12))
    assert [reward == 4.0 for reward in spy.rewards] == [False] * 12 + [True] * 8
    assert model.get_env().env_method("settings") == [("progress", "grid")]


def test_a_continued_training_has_the_later_reward_at_once():
    model = make_model()
    learn(model, 12)
    spy = Spy()
    callbacks = [RewardCallback(reward="blog", timesteps=12), spy]
    model.learn(4, callback=callbacks, reset_num_timesteps=False)
    assert spy.rewards == [4.0] * 4


@pytest.mark.parametrize(("also_eval", "expected"), [(False, "progress"), (True, "blog")])
def test_evaluation_keeps_its_reward_unless_asked(also_eval, expected):
    """Also when the EvalCallback sits deep in a list; afterwards all is as before."""
    seen = []

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            seen.extend(evaluation.eval_env.env_method("settings"))
            return True

    evaluation = EvalCallback(DummyVecEnv([ToyRace]), eval_freq=5, warn=False, verbose=0)
    nested = CallbackList([CallbackList([evaluation])])
    learn(make_model(), 5, RewardCallback(reward="blog", also_eval=also_eval), nested, Look())
    assert seen == [(expected, "grid")] * 5
    assert evaluation.eval_env.env_method("settings") == [("progress", "grid")]


@pytest.mark.parametrize(
    ("callback", "options", "message"),
    [
        (NoiseCallback, {"seed": "abc"}, "seed is 'abc'; expected a whole number >= 0"),
        (NoiseCallback, {"seed": -1}, "seed is -1; expected a whole number >= 0"),
        (NoiseCallback, {"throttle": 5}, r"throttle is 5; expected \[mu, theta, sigma\]"),
        (NoiseCallback, {"kind": "setpoint"}, "did you mean 'set_point'"),
        (NoiseDecayCallback, {"timesteps": 0}, "timesteps is .*; expected a"),
        (NoiseDecayCallback, {"timesteps": "1e5"}, "timesteps is .*; expected a"),
        *[(NoiseDecayCallback, {"floor": floor}, "floor is .*; expected a")
          for floor in (-0.1, 1.1, None)],
        *[(StochasticBrakeCallback, {"mu": mu}, "how far to brake, from 0 to 1")
          for mu in (-0.1, 5, "x")],
        (StochasticBrakeCallback, {"probability": 10}, r"share of the timesteps in \[0, 1\]"),
        *[(GradientStepsCallback, {"timesteps": 10, "gradient_steps": 2, **wrong}, "number >= 1")
          for wrong in ({"gradient_steps": 0}, {"timesteps": 0}, {"gradient_steps": 2.5},
                        {"timesteps": "1e5"})],
        (RewardCallback, {"reward": "progres"}, "did you mean 'progress'"),
        (RewardCallback, {"reward": "blog", "timesteps": -1}, "a whole number >= 0"),
        (RewardCallback, {"reward": "blog", "timesteps": False}, "a whole number >= 0"),
        (RandomStartCallback, {"start": "rnadom"}, "expected 'grid' or 'random'"),
        (RandomStartCallback, {"speed": "fast"}, "expected 0 to 150 m/s"),
        (RandomStartCallback, {"hard": 50}, "share of hard starts is 50; expected 0 to 1"),
        (NoiseCallback, {"kind": 5}, "expected 'set_point' or 'ou'"),
        (NoiseCallback, {"dt": "1e-1"}, "pass a duration above 0"),
        (StochasticBrakeCallback, {"probability": "10 %"}, "a share of the timesteps"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_told_when_the_callback_is_made(callback, options, message):
    """A worker process would die of it."""
    with pytest.raises(Sb3TorcsError, match=message):
        callback(**options)


@pytest.mark.parametrize("callback", [RewardCallback(reward="blog"), RandomStartCallback()])
def test_an_environment_without_the_setting_is_named(callback):
    """A worker process would die of the missing method, without a word."""
    model = DDPG("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu")
    with pytest.raises(InvalidOption, match=r"has no set_(reward|start)"):
        model.learn(1, callback=callback)


# ------------------------------------------------------------------------------- gradient steps


class Updates(BaseCallback):
    """Notes the updates made before each rollout, and what a model saved in it would say."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: list[int] = []
        self.saved: list[int] = []

    def _on_rollout_start(self) -> None:
        self.counts.append(self.model._n_updates)

    def _on_step(self) -> bool:
        self.saved.append(self.model.gradient_steps)
        return True


def test_a_young_training_learns_more_from_each_timestep():
    """Three updates in each of the first four rollouts, one thereafter; saved models say one."""
    model, updates = make_model(2, gradient_steps=1), Updates()
    learn(model, 12, GradientStepsCallback(gradient_steps=3, timesteps=8), updates)
    assert updates.counts == [0, 3, 6, 9, 12, 13]
    assert updates.saved == [1] * 6
    assert (model._n_updates, model.gradient_steps) == (14, 1)


def test_a_young_training_that_an_error_ended_leaves_the_steps_of_the_model():
    model = make_model(gradient_steps=1)
    young = GradientStepsCallback(gradient_steps=3, timesteps=8)
    with pytest.raises(KeyboardInterrupt):
        learn(model, 4, young, Raising())
    assert model.gradient_steps == 3
    learn(model, 4, young)
    assert model.gradient_steps == 1


@pytest.mark.parametrize("reset", [False, True])
def test_a_training_that_goes_on_is_no_longer_young(reset):
    """The timesteps are counted over all its parts, whatever SB3 counts."""
    model = make_model(gradient_steps=1)
    callback = GradientStepsCallback(gradient_steps=3, timesteps=6)
    learn(model, 4, callback)
    model.learn(4, callback=callback, reset_num_timesteps=reset)
    assert model._n_updates == 6 * 3 + 2


def test_gradient_steps_need_an_algorithm_with_a_replay():
    """PPO has none to set."""
    model = PPO("MlpPolicy", make_vec_env(ToyRace), n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(InvalidOption, match="off-policy algorithms, but the model learns by PPO"):
        model.learn(8, callback=GradientStepsCallback(gradient_steps=2, timesteps=10))


@pytest.mark.parametrize(
    "callback",
    [
        NoiseCallback,
        NoiseDecayCallback,
        StochasticBrakeCallback,
        RandomStartCallback,
        MirrorCallback,
        lambda *args: RewardCallback(*args, reward="blog"),
        lambda *args: GradientStepsCallback(*args, gradient_steps=2, timesteps=10),
    ],
)
def test_arguments_are_by_name_only(callback):
    """A number without a name in a YAML file says nothing."""
    callback()
    with pytest.raises(TypeError, match="positional"):
        callback(0.1)


def test_the_noise_base_is_abstract():
    """A noise of one's own derives from it and says how it draws."""
    with pytest.raises(TypeError, match="abstract"):
        ActuatorNoise()
