"""Let an agent go on learning on one track at a time, or on several at once.

A specialist is faster on its track than an agent for many, and forgets other tracks. `distill.py`
teaches one agent what several specialists know. This script learns one track after the other, on
one core; run it several times at once to use more. With --together one agent learns all tracks at
once, such as a student that leaves some of them.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from sb3_torcs.agents.models import driver_record, find_model, training_record
from sb3_torcs.agents.saved.file import learned_weights
from sb3_torcs.agents.saved.writing import RecordCallback, recipe
from sb3_torcs.agents.wrapping import frames_of
from sb3_torcs.callbacks import LeanUpdatesCallback, RewardCallback
from sb3_torcs.callbacks.adapting import AdaptiveLearningRateCallback, learn_values
from sb3_torcs.callbacks.progress import RacingProgressCallback
from sb3_torcs.car import check_count
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.vec_env import MirrorVecEnv, TorcsVecEnv

TIMESTEPS, BATCH = 128, 2048  # of each car between updates; of a step of Adam
NOT_DRIVING = ("track", "reward", "max_episode_steps")


@dataclass(frozen=True)
class Settings:
    """What differs between a specialist and an agent for several tracks."""

    cars: int  # at once
    mirror: bool  # whether every other car drives on the mirror image of its road
    grip: float | list[float]  # of that of the game
    episode: int  # timesteps
    hard: float  # share of the episodes that begin where another left the road
    off_line: float  # weight of wheels beside the road
    crash: float  # weight of the end of an episode beside the road
    last_crash: float  # the same in the last third of the training, when it tries little any more
    ent_coef: float
    noise: tuple[float, float]  # logarithms of the standard deviations at first, steering and pedal
    last_kl: float  # target of the divergence per update at the end [nats]
    first_factor: float  # on the learning rate at the beginning, from which it adapts


SPECIALIST = Settings(
    cars=64, mirror=False, grip=1.0, episode=600, hard=0.5, off_line=-1.0, crash=-1.0,
    last_crash=-1.0, ent_coef=0.001, noise=(-1.7, -0.7), last_kl=0.003, first_factor=1.0,
)  # fmt: skip
TOGETHER = Settings(
    cars=128, mirror=True, grip=[0.9, 1.1], episode=300, hard=0.7, off_line=-2.0, crash=-3.0,
    last_crash=-10.0, ent_coef=0.002, noise=(-2.0, -1.0), last_kl=0.0024, first_factor=0.1,
)  # fmt: skip

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("driver", help="a model of PPO to go on from, such as ppo-any-road")
parser.add_argument("--track", nargs="+", required=True, help="one, or several")
parser.add_argument(
    "--together", action="store_true", help="learn all tracks at once, and save one model"
)
parser.add_argument("--timesteps", type=int, default=1_048_576, help="on each track, or together")
parser.add_argument(
    "--values",
    type=int,
    default=400_000,
    help="timesteps in which only the value function learns, with --together",
)
parser.add_argument("--damage", type=float, default=-0.02, help="weight of a point of damage")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--folder", type=Path, default=Path("logs/specialists"))


def reward(args: argparse.Namespace, settings: Settings, crash: float) -> dict[str, float]:
    """Return the weights of the reward's terms."""
    return {
        "progress": 1.0, "off_line": settings.off_line, "leaving": -0.5, "crash": crash,
        "scale": 0.1, "damage": args.damage,
    }  # fmt: skip


def make_cars(args: argparse.Namespace, env_kwargs: dict, settings: Settings) -> VecEnv:
    """Make cars that begin anywhere on the road, many of them where others left it before."""
    cars = TorcsVecEnv(
        settings.cars, threads=1, start="random", reward=reward(args, settings, settings.crash),
        conditions={"grip": settings.grip}, max_episode_steps=settings.episode, **env_kwargs,
    )  # fmt: skip
    cars.env_method("set_random_speed", 80.0)
    cars.env_method("set_hard_starts", settings.hard)
    return MirrorVecEnv(cars) if settings.mirror else cars


def make_model(
    known: PPO, weights: dict, cars: VecEnv, args: argparse.Namespace, settings: Settings
) -> PPO:
    """
    Make a new learner, since shipped files hold no optimizer, and their learning rate has fallen.

    Weights that are missing, as those of the value function of a student, stay new.
    """
    model = PPO(
        known.policy_class, cars, learning_rate=1e-3, n_steps=TIMESTEPS, batch_size=BATCH,
        gamma=0.985, ent_coef=settings.ent_coef, policy_kwargs=known.policy_kwargs,
        seed=args.seed, device="cpu",
    )  # fmt: skip
    model.policy.load_state_dict({**model.policy.state_dict(), **weights})
    return model


def go_on(args: argparse.Namespace, tracks: list[str], settings: Settings) -> Path:
    """Go on learning, and return the model's file."""
    file = find_model(args.driver)
    if training_record(file).algo != "ppo":
        raise SystemExit(f"{args.driver} is no model of PPO; give one, e.g. ppo-any-road")
    trained = driver_record(args.driver).env_kwargs
    if trained.get("action") != "pedal":
        raise SystemExit(
            f'{args.driver} does not drive with action="pedal"; give one, e.g. ppo-any-road'
        )
    frames = frames_of(driver_record(args.driver).hyperparameters) or 1
    if frames > 1:
        raise SystemExit(
            f"{args.driver} sees {frames} timesteps at once; give another, e.g. ppo-any-road"
        )
    env_kwargs = {name: value for name, value in trained.items() if name not in NOT_DRIVING}
    env_kwargs["track"] = tracks if len(tracks) > 1 else tracks[0]
    cars = make_cars(args, env_kwargs, settings)
    known = PPO.load(file, device="cpu")
    model = make_model(known, learned_weights(file), cars, args, settings)
    if args.together:
        learn_values(model, args.values)
        model = make_model(known, model.policy.state_dict(), cars, args, settings)
    with th.no_grad():
        model.policy.log_std.copy_(th.tensor(settings.noise))
    callbacks = [
        RecordCallback(recipe("ppo", "Torcs-v0", {"env_kwargs": env_kwargs})),
        RacingProgressCallback(),
        LeanUpdatesCallback(),
        AdaptiveLearningRateCallback(
            kl=0.012, last_kl=settings.last_kl, first_factor=settings.first_factor
        ),
        RewardCallback(
            timesteps=2 * args.timesteps // 3, reward=reward(args, settings, settings.last_crash)
        ),
    ]
    model.learn(args.timesteps, callback=callbacks)
    cars.close()
    specialist = args.folder / f"{Path(tracks[0]).stem if len(tracks) == 1 else 'together'}.zip"
    model.save(specialist)
    return specialist


def main() -> None:
    args = parser.parse_args()
    check_count("--timesteps", args.timesteps)
    args.folder.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)
    together = args.together
    settings = TOGETHER if together else SPECIALIST
    for tracks in [args.track] if together else [[track] for track in args.track]:
        file = go_on(args, tracks, settings)
        choice = f" --track {tracks[0]}" if len(tracks) > 1 else ""
        cars = driver_record(file).env_kwargs.get("car")
        choice += f" --car {cars[0]}" if isinstance(cars, list) else ""
        print(f"saved {file}; drive it: sb3-torcs evaluate {file}{choice}")


if __name__ == "__main__":
    with ends_in_a_line():
        main()
