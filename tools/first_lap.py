"""Measure how soon a shipped recipe laps from nothing, in timesteps and seconds."""

import argparse
import time

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.evaluation.protocol import RACE_LAPS, evaluate, race_environment
from sb3_torcs.training import zoo
from sb3_torcs.training.build import build

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--algo", default="ppo", help="default: ppo")
parser.add_argument("--env", default="Torcs-v0", help="default: Torcs-v0")
parser.add_argument("--seeds", type=int, default=15, help="seeds 0, 1, ...; default: 15")
parser.add_argument("--every", type=int, default=8192, help="timesteps between two races")
parser.add_argument("--limit", type=float, default=110.0, help="give a seed up after so long [s]")


class Races(BaseCallback):
    """Drive a race of three laps from the grid now and then, until all three are driven."""

    def __init__(self, env, every, limit):
        super().__init__()
        self.env, self.every, self.limit = env, every, limit
        self.first = self.three = None  # timesteps and seconds
        self.raced = 0

    def _on_training_start(self):
        self.began = time.monotonic()

    def _on_step(self):
        return self.three is None and time.monotonic() - self.began < self.limit

    def _on_rollout_end(self):
        if self.num_timesteps - self.raced < self.every:
            return
        self.raced = self.num_timesteps
        (race,) = evaluate(self.env, self.model)
        now = f"{self.num_timesteps:,} timesteps, {time.monotonic() - self.began:.1f} s"
        if race.laps:
            self.first = self.first or now
        if race.laps == RACE_LAPS:
            self.three = now


def main() -> None:
    args = parser.parse_args()
    th.set_num_threads(1)
    entry = zoo.read_entry(zoo.config_file(args.algo), args.env)
    for seed in range(args.seeds):
        model, callbacks = build(args.algo, args.env, entry, seed=seed)
        races = Races(race_environment(args.env, entry["env_kwargs"]), args.every, args.limit)
        model.learn(entry["n_timesteps"], callback=CallbackList([*callbacks, races]))
        print(f"seed {seed}: first lap {races.first}; {RACE_LAPS} laps {races.three}", flush=True)
        races.env.close()
        model.get_env().close()


if __name__ == "__main__":
    with ends_in_a_line():
        main()
