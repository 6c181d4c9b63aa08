"""Train PPO to race on one track: first alone, then behind robots, while some cars stay alone.

Each car of each race is an environment of TorcsVecEnv, so that stock PPO learns from all of them.
"""

import argparse
from pathlib import Path

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_torcs.agents.model_writing import RecordCallback, recipe
from sb3_torcs.callbacks import AdaptiveLearningRateCallback, LeanUpdatesCallback
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.sensors import feature_slices
from sb3_torcs.vec_env import JoinedVecEnv, TorcsVecEnv

SENSORS = ("base", "line", "rivals")
# The fields of robots, of which each race draws one. Those with a number drive another car.
FIELDS = (
    ("berniw", "bt", "inferno", "lliaw", "olethros", "tita", "inferno:4"),
    ("inferno:4", "bt:3", "tita:4", "lliaw:4", "berniw", "olethros", "tita"),
    ("lliaw", "olethros", "tita", "inferno:4", "bt", "tita:4", "berniw"),
    ("tita", "bt", "berniw"),
)
AGENTS = 3  # in each race, behind the robots
ALONE = {
    "progress": 1.0, "off_line": -1.0, "leaving": -0.5, "damage": -0.02, "crash": -1.0, "scale": 0.1
}  # fmt: skip
RACING = {
    "progress": 1.0, "off_line": -0.5, "leaving": -0.3, "damage": -0.3, "passing": 1.0,
    "places": 20.0, "contact": -1.0, "fault": -10.0, "crash": -1.0, "scale": 0.1,
}  # fmt: skip

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--track", default="aalborg")
parser.add_argument("--alone", type=int, default=1_310_720, help="timesteps without other cars")
parser.add_argument("--robots", type=int, default=6_000_000, help="timesteps against robots")
parser.add_argument("--races", type=int, default=16, help="held at once")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--threads", type=int, help="default: one per core")
parser.add_argument("--folder", type=Path, default=Path("logs/racer"))


def make_model(env: VecEnv, seed: int, n_steps: int, gamma: float) -> PPO:
    """Make the learner of a stage, with four batches of each rollout."""
    return PPO(
        BoundedPolicy,
        env,
        learning_rate=1e-3,
        n_steps=n_steps,
        batch_size=n_steps * env.num_envs // 4,
        gamma=gamma,
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
    env_kwargs: dict, args: argparse.Namespace, stage: str, kl: float, last_kl: float
) -> list[BaseCallback]:
    """Save models with what `sb3-torcs race` has to know of their training."""
    asked = recipe("ppo", "Torcs-v0", {"env_kwargs": env_kwargs})
    every = CheckpointCallback(4096, str(args.folder), name_prefix=stage)  # timesteps of each car
    learning = [LeanUpdatesCallback(), AdaptiveLearningRateCallback(kl=kl, last_kl=last_kl)]
    return [RecordCallback(asked), *learning, every]


def cars_alone(number: int, args: argparse.Namespace, env_kwargs: dict) -> TorcsVecEnv:
    """Make cars that begin anywhere on the road, half of them where others left it before."""
    cars = TorcsVecEnv(
        number,
        threads=args.threads,
        reward=ALONE,
        start="random",
        max_episode_steps=1000,
        **env_kwargs,
    )
    cars.env_method("set_random_speed", 65.0)  # [m/s]
    cars.env_method("set_hard_starts", 0.5)
    return cars


def cars_in_races(args: argparse.Namespace, env_kwargs: dict) -> TorcsVecEnv:
    """
    Make races that begin on the grid, with the agents behind.

    A start elsewhere would let each robot plan its line anew. A car that spins, or is pushed off
    the road, learns to come back to it.
    """
    return TorcsVecEnv(
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


def begin_to_race(policy: BoundedPolicy) -> None:
    """
    Let a policy that has never met a car see others without fright, and try things again.

    Alone it saw zeros for rivals, so the weights of theirs are those that it was born with. And it
    has become sure of what to do: who never brakes does not find out that it ends a long contact.
    """
    rivals = [where for name, where in feature_slices(SENSORS).items() if "rivals" in name]
    with th.no_grad():
        for net in (policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net):
            for columns in rivals:
                net[0].weight[:, columns] = 0.0
        policy.log_std.copy_(th.tensor([-2.0, -0.7]))


def main() -> None:
    args = parser.parse_args()
    env_kwargs = {
        "track": args.track, "sensors": list(SENSORS), "range_finders": "narrow",
        "action": "pedal", "gearbox": "road_speed", "action_repeat": 5, "unstick": True,
        "keep_distance": True,
    }  # fmt: skip
    alone = cars_alone(64, args, env_kwargs)
    first = make_model(alone, args.seed, n_steps=128, gamma=0.985)
    first.learn(args.alone, callback=callbacks(env_kwargs, args, "alone", 0.012, 0.003))
    alone.close()

    # Some cars stay alone, for the pace: in races they are seldom free to drive at their own.
    parts = [cars_in_races(args, env_kwargs), cars_alone(2 * args.races, args, env_kwargs)]
    races = JoinedVecEnv(parts)
    # Damage comes seldom and in heaps, so that short rollouts would lead astray. To follow a slower
    # car costs little at once, and much in the end, so it looks further ahead.
    model = make_model(races, args.seed, n_steps=256, gamma=0.99)
    model.policy.load_state_dict(first.policy.state_dict())
    begin_to_race(model.policy)
    model.learn(args.robots, callback=callbacks(env_kwargs, args, "races", 0.01, 0.002))
    races.close()
    model.save(args.folder / "model")
    print(f"saved {args.folder}/model.zip; race it: sb3-torcs race {args.folder}/model.zip inferno")


if __name__ == "__main__":
    main()
