"""Let an agent go on learning on one track at a time: it becomes a specialist for each.

A specialist is faster on its track than an agent for many, and forgets other tracks. `distill.py`
teaches one agent what several specialists know. This script learns one track after the other, on
one core; run it several times at once to use more.
"""

import argparse
from pathlib import Path

import torch as th
from stable_baselines3 import PPO

from sb3_torcs.agents.model_algorithm import told_algorithm
from sb3_torcs.agents.model_file import learned_weights, saved_data
from sb3_torcs.agents.model_writing import RecordCallback, recipe
from sb3_torcs.agents.models import driver_record, find_model
from sb3_torcs.callbacks import AdaptiveLearningRateCallback, LeanUpdatesCallback
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.vec_env import TorcsVecEnv

CARS, TIMESTEPS = 64, 128  # at once, and of each between updates
REWARD = {"progress": 1.0, "off_line": -1.0, "leaving": -0.5, "crash": -1.0, "scale": 0.1}
NOISE = -1.7, -0.7  # logarithms of the standard deviations at first, steering and pedal
NOT_DRIVING = ("track", "reward", "max_episode_steps")

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("driver", help="a model of PPO to go on from, such as ppo-roads")
parser.add_argument("--track", nargs="+", required=True, help="one, or several")
parser.add_argument("--timesteps", type=int, default=1_048_576, help="on each track")
parser.add_argument("--damage", type=float, default=-0.02, help="weight of a point of damage")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--folder", type=Path, default=Path("logs/specialists"))


def specialize(args: argparse.Namespace, track: str) -> Path:
    """Go on learning on one track, and return the model's file."""
    file = find_model(args.driver)
    if told_algorithm(saved_data(file)) != "ppo":
        raise SystemExit(f"{args.driver} is no model of PPO; give one, e.g. ppo-roads")
    trained = driver_record(args.driver).env_kwargs
    env_kwargs = {name: value for name, value in trained.items() if name not in NOT_DRIVING}
    env_kwargs["track"] = track
    reward = {**REWARD, "damage": args.damage}
    cars = TorcsVecEnv(
        CARS, threads=1, start="random", reward=reward, max_episode_steps=600, **env_kwargs
    )
    cars.env_method("set_random_speed", 80.0)
    cars.env_method("set_hard_starts", 0.5)
    known = PPO.load(file, device="cpu")
    # A new learner, since shipped files hold no optimizer, and their learning rate has fallen.
    model = PPO(
        known.policy_class, cars, learning_rate=1e-3, n_steps=TIMESTEPS,
        batch_size=TIMESTEPS * CARS // 4, gamma=0.985, ent_coef=0.001,
        policy_kwargs=known.policy_kwargs, seed=args.seed, device="cpu",
    )  # fmt: skip
    # The shipped file of a student has no value function: the new one stays.
    model.policy.load_state_dict({**model.policy.state_dict(), **learned_weights(file)})
    with th.no_grad():
        model.policy.log_std.copy_(th.tensor(NOISE))
    callbacks = [
        RecordCallback(recipe("ppo", "Torcs-v0", {"env_kwargs": env_kwargs})),
        LeanUpdatesCallback(),
        AdaptiveLearningRateCallback(kl=0.012, last_kl=0.003),
    ]
    model.learn(args.timesteps, callback=callbacks)
    cars.close()
    specialist = args.folder / f"{track}.zip"
    model.save(specialist)
    return specialist


def main() -> None:
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)
    for track in args.track:
        file = specialize(args, track)
        print(f"saved {file}; drive it: sb3-torcs evaluate {file}")


if __name__ == "__main__":
    with ends_in_a_line():
        main()
