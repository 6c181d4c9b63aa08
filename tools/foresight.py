"""Let an agent race with foresight: the engine's snapshots tell which hits are coming."""

import argparse

import gymnasium as gym
import numpy as np

from sb3_torcs.agents.drivers import find_driver
from sb3_torcs.agents.models import load_driver
from sb3_torcs.errors import ends_in_a_line

ROBOTS = ("berniw", "bt", "inferno", "lliaw", "olethros", "tita", "inferno:4", "bt:3", "tita:4")
LOOK, AHEAD, HELD = 3, 22, 6  # timesteps: between two looks, looked ahead, of a change
HIT = 15.0  # [points] of damage that are worth a change
PRICE = 0.1  # [m] per point
CHANGES = [(turn, pedal) for turn in (0.0, -0.08, 0.08, -0.2, 0.2) for pedal in (None, 0.0, -0.5)]
CHANGES += [(0.0, -1.0), (0.0, 1.0), (-0.1, 1.0), (0.1, 1.0)]  # the first of all is none

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("agent", nargs="?", default="ppo-racer", help="with a signed pedal")
parser.add_argument("--races", type=int, default=5, help="seeds 0, 1, ... of the grid; default: 5")
parser.add_argument("--laps", type=int, default=5)
parser.add_argument("--blind", action="store_true", help="race without foresight")


class Racer:
    """
    An agent in a race that can be driven on, and taken back.

    :param driver: of the agent
    :param env: the race
    """

    def __init__(self, driver, env):
        self.driver, self.env, self.world = driver, env, env.backend

    def act(self, seen, change):
        """Return the agent's action, changed."""
        (turn, pedal), action = change, self.driver.predict(seen, deterministic=True)[0].copy()
        action[0] = np.clip(action[0] + turn, -1.0, 1.0)
        if pedal is not None:
            action[1] = pedal if pedal > 0.0 else min(action[1], pedal)
        return action

    def worth(self, seen, change):
        """Look ahead, and return the damage that a change brings, and what it is worth [m]."""
        begin, episode, moment = self.env.car, self.env.episode, self.world.save()
        for timestep in range(AHEAD):
            seen = self.env.step(self.act(seen, change if timestep < HELD else CHANGES[0]))[0]
        end, self.env.episode = self.env.car, episode
        self.world.restore(moment)
        damage = end.damage - begin.damage
        way = end.distance_raced - begin.distance_raced + 0.5 * min(end.speed_x, 60.0)
        return damage, way - PRICE * damage

    def best_change(self, seen):
        """Choose a change if a hit is coming."""
        if self.worth(seen, CHANGES[0])[0] <= HIT:
            return CHANGES[0]
        return max(CHANGES, key=lambda change: self.worth(seen, change)[1])


def race(args, seed):
    """Drive a race from the last place, and return the last info."""
    order = np.random.default_rng(seed).permutation(len(ROBOTS))
    kept = find_driver(args.agent).record.env_kwargs
    options = {"opponents": [ROBOTS[i] for i in order], "laps": args.laps, "max_episode_steps": -1}
    options |= {
        "ends": {"runoff": 30.0, "recovery": 60.0}
    }  # a car that spins or leaves the road races on
    env = gym.make("sb3_torcs:Torcs-v0", **{**kept, **options})
    racer = Racer(load_driver(args.agent, env), env.unwrapped)
    seen, _ = env.reset(seed=seed)
    env.unwrapped.warns_after_end = False  # a look ahead may go beyond it
    timestep, over, change = 0, False, CHANGES[0]
    while not over:
        if timestep % LOOK == 0 and not args.blind:
            change = racer.best_change(seen)
        seen, _, ended, cut, info = env.step(racer.act(seen, change))
        timestep, over = timestep + 1, ended or cut
    env.close()
    return info


def main() -> None:
    args = parser.parse_args()
    for seed in range(args.races):
        end = race(args, seed)
        place, damage = end["car"].race_position, end["damage"]
        print(f"race {seed}: place {place}, {damage:.0f} points of damage, ended by {end['end']}")


if __name__ == "__main__":
    with ends_in_a_line():
        main()
