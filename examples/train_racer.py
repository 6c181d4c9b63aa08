"""Train PPO to race on one track: first alone, then four copies of it against robots.

Each car of each race is an environment of TorcsVecEnv, so that stock PPO learns from all of them.
"""

import argparse
from pathlib import Path

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from torch import nn

from sb3_torcs.agents.model_writing import RecordCallback, recipe
from sb3_torcs.callbacks import (
    AdaptiveLearningRateCallback,
    LeanUpdatesCallback,
    RandomStartCallback,
)
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.sensors import feature_slices
from sb3_torcs.vec_env import TorcsVecEnv

SENSORS = ("base", "line", "rivals")
# The fields of robots, of which each race draws one.
FIELDS = (
    ("lliaw", "olethros", "inferno", "bt", "berniw", "tita"),
    ("inferno:4", "bt:3", "tita:4", "lliaw:4", "berniw:3", "olethros:2"),
    ("tita:3", "bt:2", "berniw:2"),
)
ALONE = {
    "progress": 1.0, "off_line": -1.0, "leaving": -0.5, "damage": -0.02, "crash": -1.0, "scale": 0.1
}  # fmt: skip
RACING = {
    "progress": 1.0, "off_line": -0.3, "leaving": -0.1, "damage": -0.1, "closing": -2.0,
    "places": 10.0, "contact": -1.0, "fault": -20.0, "crash": -1.0, "scale": 0.1,
}  # fmt: skip

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--track", default="aalborg")
parser.add_argument("--alone", type=int, default=1_000_000, help="timesteps without other cars")
parser.add_argument("--robots", type=int, default=10_000_000, help="timesteps against robots")
parser.add_argument("--cars", type=int, default=64, help="that learn at once, a multiple of 16")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--threads", type=int, help="default: one per core")
parser.add_argument("--folder", type=Path, default=Path("logs/racer"))


def callbacks(
    env_kwargs: dict, args: argparse.Namespace, *, random_starts: bool
) -> list[BaseCallback]:
    """Save models with what `sb3-torcs race` has to know of their training."""
    asked = recipe("ppo", "Torcs-v0", {"env_kwargs": env_kwargs})
    starts = [RandomStartCallback(speed=65.0, hard=0.5)] if random_starts else []
    every = CheckpointCallback(262_144 // args.cars, str(args.folder), name_prefix="racer")
    learning = [LeanUpdatesCallback(), AdaptiveLearningRateCallback(kl=0.012, last_kl=0.003)]
    return [RecordCallback(asked), *starts, *learning, every]


def look_away(policy: BoundedPolicy) -> None:
    """
    Let a policy that has never met a car begin as if it saw none.

    Alone on the road it saw the same numbers all the time: rivals 200 m ahead, which have no speed
    and no size. The weights of all others are those that it was born with.
    """
    where = feature_slices(SENSORS)
    rivals = [where[name] for name in where if name.startswith("rivals")]
    with th.no_grad():
        for net in (policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net):
            net[0].bias += net[0].weight[:, where["rivals_along"]].sum(dim=1)
            for columns in rivals:
                net[0].weight[:, columns] = 0.0


def main() -> None:
    args = parser.parse_args()
    env_kwargs = {
        "track": args.track, "sensors": list(SENSORS), "range_finders": "narrow",
        "action": "pedal", "gearbox": "road_speed", "action_repeat": 5,
    }  # fmt: skip
    alone = TorcsVecEnv(
        args.cars, threads=args.threads, reward=ALONE, max_episode_steps=1000, **env_kwargs
    )
    model = PPO(
        BoundedPolicy,
        alone,
        learning_rate=1e-3,
        n_steps=128,
        batch_size=2048,
        gamma=0.985,
        ent_coef=0.001,
        policy_kwargs={
            "net_arch": [128, 128],
            "activation_fn": nn.ReLU,
            "log_std_init": [-1.0, -0.3],  # steering, pedal
        },
        seed=args.seed,
        device="cpu",
    )
    model.learn(args.alone, callback=callbacks(env_kwargs, args, random_starts=True))
    alone.close()
    look_away(model.policy)
    # Alone it has become sure of what to do. Among others it has to try again.
    with th.no_grad():
        model.policy.log_std.copy_(th.tensor([-1.9, -1.1]))

    # A race begins on the grid, with the copies behind: a start elsewhere would let each robot plan
    # its line anew. A car that is pushed off the road learns to come back to it.
    races = TorcsVecEnv(
        args.cars // 4,
        agents=4,
        threads=args.threads,
        reward=RACING,
        opponents=FIELDS,
        runoff=8.0,
        max_episode_steps=1000,
        **env_kwargs,
    )
    model.set_env(races)
    model.learn(
        args.robots,
        callback=callbacks(env_kwargs, args, random_starts=False),
        reset_num_timesteps=False,
    )
    races.close()
    model.save(args.folder / "model")
    print(f"saved {args.folder}/model.zip; race it: sb3-torcs race {args.folder}/model.zip inferno")


if __name__ == "__main__":
    main()
