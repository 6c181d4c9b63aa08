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
# The fields of robots, of which each race draws one. Those with a number drive another car.
FIELDS = (
    ("berniw", "bt", "inferno", "lliaw", "olethros", "tita", "inferno:4"),
    ("lliaw", "olethros", "tita", "inferno:4", "bt", "tita:4", "berniw"),
    ("inferno:4", "bt:3", "tita:4", "lliaw:4", "berniw", "olethros"),
    ("tita", "bt", "berniw"),
)
AGENTS = 3  # in each race, behind the robots
ALONE = {
    "progress": 1.0, "off_line": -1.0, "leaving": -0.5, "damage": -0.02, "crash": -1.0, "scale": 0.1
}  # fmt: skip
RACING = {
    "progress": 1.0, "off_line": -0.3, "leaving": -0.1, "damage": -0.2, "closing": -2.0,
    "places": 10.0, "contact": -1.0, "fault": -10.0, "crash": -1.0, "scale": 0.1,
}  # fmt: skip

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--track", default="aalborg")
parser.add_argument("--alone", type=int, default=1_000_000, help="timesteps without other cars")
parser.add_argument("--robots", type=int, default=8_000_000, help="timesteps against robots")
parser.add_argument("--races", type=int, default=20, help="held at once")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--threads", type=int, help="default: one per core")
parser.add_argument("--folder", type=Path, default=Path("logs/racer"))


def make_model(env: TorcsVecEnv, seed: int, n_steps: int) -> PPO:
    """Make the learner of a stage, with four batches of each rollout."""
    return PPO(
        BoundedPolicy,
        env,
        learning_rate=1e-3,
        n_steps=n_steps,
        batch_size=n_steps * env.num_envs // 4,
        gamma=0.985,
        ent_coef=0.001,
        policy_kwargs={
            "net_arch": [128, 128],
            "activation_fn": nn.ReLU,
            "log_std_init": [-1.0, -0.3],  # steering, pedal
        },
        seed=seed,
        device="cpu",
    )


def callbacks(
    env_kwargs: dict, args: argparse.Namespace, stage: str, starts: list[BaseCallback], kl: float
) -> list[BaseCallback]:
    """Save models with what `sb3-torcs race` has to know of their training."""
    asked = recipe("ppo", "Torcs-v0", {"env_kwargs": env_kwargs})
    every = CheckpointCallback(4096, str(args.folder), name_prefix=stage)  # timesteps of each car
    learning = [LeanUpdatesCallback(), AdaptiveLearningRateCallback(kl=kl, last_kl=0.002)]
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
        "action": "pedal", "gearbox": "road_speed", "action_repeat": 5, "unstick": True,
    }  # fmt: skip
    alone = TorcsVecEnv(
        64, threads=args.threads, reward=ALONE, max_episode_steps=1000, **env_kwargs
    )
    first = make_model(alone, args.seed, n_steps=128)
    starts = [RandomStartCallback(speed=65.0, hard=0.5)]
    first.learn(args.alone, callback=callbacks(env_kwargs, args, "alone", starts, kl=0.012))
    alone.close()

    # A race begins on the grid, with the agents behind: a start elsewhere would let each robot plan
    # its line anew. A car that spins, or is pushed off the road, learns to come back to it.
    races = TorcsVecEnv(
        args.races,
        agents=AGENTS,
        threads=args.threads,
        reward=RACING,
        opponents=FIELDS,
        runoff=8.0,
        recovery=20.0,
        max_episode_steps=[450, 450, 1400],  # damage is done in the crowd of the first minute
        **env_kwargs,
    )
    # Damage comes seldom and in heaps, so that short rollouts would lead astray.
    model = make_model(races, args.seed, n_steps=256)
    model.policy.load_state_dict(first.policy.state_dict())
    look_away(model.policy)
    # Alone it has become sure of what to do. Among others it has to try again, the brake above all:
    # who never brakes does not find out that it ends a long contact.
    with th.no_grad():
        model.policy.log_std.copy_(th.tensor([-2.0, -0.5]))
    model.learn(args.robots, callback=callbacks(env_kwargs, args, "races", [], kl=0.006))
    races.close()
    model.save(args.folder / "model")
    print(f"saved {args.folder}/model.zip; race it: sb3-torcs race {args.folder}/model.zip inferno")


if __name__ == "__main__":
    main()
