"""Train PPO to race: first alone, then behind robots, while some cars stay alone.

Each car of each race is an environment of TorcsVecEnv, so that stock PPO learns from all of them.
It learns one track, or several, to race on those that it never saw. With --driver it goes on from a
model that drives alone already, with --racer from one that races. With --ancestor it goes on from a
racer that was trained so, and races against itself, this ancestor and robots.
"""

import argparse
from dataclasses import dataclass
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
from sb3_torcs.vec_env import JoinedVecEnv, MirrorVecEnv, TorcsVecEnv

SENSORS = ("base", "line", "rivals")
# The fields of robots, of which each race draws one. Those with a number drive another car.
FIELDS = (
    ("berniw", "bt", "inferno", "lliaw", "olethros", "tita", "inferno:4"),
    ("inferno:4", "bt:3", "tita:4", "lliaw:4", "berniw", "olethros", "tita"),
    ("lliaw", "olethros", "tita", "inferno:4", "bt", "tita:4", "berniw"),
    ("tita", "bt", "berniw"),
)
BESIDE_ANCESTORS = ((), ("bt", "berniw", "inferno:4"), ("lliaw", "olethros", "tita", "bt:3"))
AGENTS = 3  # in each race, behind the others


@dataclass(frozen=True)
class Settings:
    """What differs between a racer for one track and one for all roads."""

    timesteps_alone: int
    cars_alone: int  # at once, before they meet others
    beside_races: int  # cars alone per race
    episode: int  # timesteps of a car alone
    speed: float  # of a car alone at the begin of an episode, at most [m/s]
    hard: float  # share of the episodes alone that begin where another left the road
    off_line: tuple[float, float]  # what it costs to be off the racing line, alone and in races
    batch_size: int | None  # None is a quarter of a rollout
    ent_coef: float
    mirror: bool  # whether every other car drives on the mirror image of its road
    grip: float | list[float]  # of a car alone, of that of the game


ONE_TRACK = Settings(
    timesteps_alone=1_310_720, cars_alone=64, beside_races=2, episode=1000, speed=65.0, hard=0.5,
    off_line=(-1.0, -0.5), batch_size=None, ent_coef=0.001, mirror=False, grip=1.0,
)  # fmt: skip
ALL_ROADS = Settings(
    timesteps_alone=3_145_728, cars_alone=128, beside_races=3, episode=300, speed=80.0, hard=0.7,
    off_line=(-4.0, -1.5), batch_size=2048, ent_coef=0.004, mirror=True,
    grip=[0.85, 1.0],
)  # fmt: skip


def reward_alone(off_line: float) -> dict[str, float]:
    """Return the weights of the reward's terms for a car that is alone."""
    return {
        "progress": 1.0, "off_line": off_line, "leaving": -0.5, "damage": -0.02, "crash": -1.0,
        "scale": 0.1,
    }  # fmt: skip


def reward_in_races(off_line: float) -> dict[str, float]:
    """Return the weights of the reward's terms for a car among others."""
    return {
        "progress": 1.0, "off_line": off_line, "leaving": -0.3, "damage": -0.3, "passing": 1.0,
        "places": 20.0, "contact": -1.0, "fault": -10.0, "crash": -1.0, "scale": 0.1,
    }  # fmt: skip


parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--track", nargs="+", default=["aalborg"], help="one, or several")
parser.add_argument("--alone", type=int, help="timesteps without other cars")
parser.add_argument("--robots", type=int, default=6_000_000, help="timesteps in races")
parser.add_argument("--driver", type=Path, help="model that drives alone, to go on from")
parser.add_argument("--racer", type=Path, help="model that races, to go on from")
parser.add_argument("--ancestor", type=Path, help="model.zip of a racer from which to go on")
parser.add_argument("--races", type=int, default=16, help="held at once")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--threads", type=int, help="default: one per core")
parser.add_argument("--folder", type=Path, default=Path("logs/racer"))


def make_model(env: VecEnv, seed: int, n_steps: int, gamma: float, settings: Settings) -> PPO:
    """Make the learner of a stage."""
    return PPO(
        BoundedPolicy,
        env,
        learning_rate=1e-3,
        n_steps=n_steps,
        batch_size=settings.batch_size or n_steps * env.num_envs // 4,
        gamma=gamma,
        ent_coef=settings.ent_coef,
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


def cars_alone(
    number: int, args: argparse.Namespace, env_kwargs: dict, settings: Settings
) -> TorcsVecEnv:
    """Make cars that begin anywhere on the road, many of them where others left it before."""
    cars = TorcsVecEnv(
        number,
        threads=args.threads,
        reward=reward_alone(settings.off_line[0]),
        start="random",
        max_episode_steps=settings.episode,
        grip=settings.grip,
        **env_kwargs,
    )
    cars.env_method("set_random_speed", settings.speed)
    cars.env_method("set_hard_starts", settings.hard)
    return cars


def mirrored(cars: VecEnv, settings: Settings) -> VecEnv:
    """Let every other car drive on the mirror image of its road, if that is wanted."""
    return MirrorVecEnv(cars) if settings.mirror else cars


def fields(args: argparse.Namespace) -> tuple[tuple[str, ...], ...]:
    """Tell who may start in front of the agents: robots, or the ancestor, too."""
    if args.ancestor is None:
        return FIELDS
    return tuple((*[str(args.ancestor)] * 2, *robots) for robots in BESIDE_ANCESTORS)


def cars_in_races(args: argparse.Namespace, env_kwargs: dict, settings: Settings) -> TorcsVecEnv:
    """
    Make races that begin on the grid, with the agents behind.

    A start elsewhere would let each robot plan its line anew. A car that spins, or is pushed off
    the road, learns to come back to it.
    """
    return TorcsVecEnv(
        args.races,
        agents=AGENTS,
        threads=args.threads,
        reward=reward_in_races(settings.off_line[1]),
        opponents=fields(args),
        runoff=8.0,
        recovery=20.0,
        max_episode_steps=[450, 450, 1400],  # damage is done in the crowd of the first minute
        **env_kwargs,
    )


def learn_alone(args: argparse.Namespace, env_kwargs: dict, settings: Settings) -> dict:
    """Learn to drive where there is nobody, and return the policy's weights."""
    cars = mirrored(cars_alone(settings.cars_alone, args, env_kwargs, settings), settings)
    model = make_model(cars, args.seed, n_steps=128, gamma=0.985, settings=settings)
    timesteps = args.alone or settings.timesteps_alone
    model.learn(timesteps, callback=callbacks(env_kwargs, args, "alone", 0.012, 0.003))
    cars.close()
    return model.policy.state_dict()


def weights_of(path: Path) -> dict:
    """Return the policy's weights in a model file."""
    return PPO.load(path, device="cpu").policy.state_dict()


def begin_to_race(weights: dict) -> None:
    """
    Let a policy that has never met a car see others without fright.

    Alone it saw zeros for rivals, so the weights of theirs are those that it was born with. A
    driver that never saw them has none. Rivals come last.
    """
    features = feature_slices(SENSORS)
    seen = min(where.start for name, where in features.items() if "rivals" in name)
    missing = max(where.stop for where in features.values()) - seen
    for net in ("policy_net", "value_net"):
        name = f"mlp_extractor.{net}.0.weight"
        weights[name] = nn.functional.pad(weights[name][:, :seen], (0, missing))


def main() -> None:
    args = parser.parse_args()
    several = len(args.track) > 1
    settings = ALL_ROADS if several else ONE_TRACK
    env_kwargs = {
        "track": args.track if several else args.track[0],
        "sensors": list(SENSORS), "range_finders": "narrow", "action": "pedal",
        "gearbox": "road_speed", "action_repeat": 5,
        "unstick": True, "keep_distance": True, "keep_clear": True,
    }  # fmt: skip
    racer, driver = args.ancestor or args.racer, args.driver
    if racer is not None:
        weights = weights_of(racer)
    else:
        weights = weights_of(driver) if driver else learn_alone(args, env_kwargs, settings)
        begin_to_race(weights)

    # Some cars stay alone, for the pace: in races they are seldom free to drive at their own.
    beside = cars_alone(settings.beside_races * args.races, args, env_kwargs, settings)
    cars = mirrored(JoinedVecEnv([cars_in_races(args, env_kwargs, settings), beside]), settings)
    # Damage comes seldom and in heaps, so that short rollouts would lead astray. To follow a slower
    # car costs little at once, and much in the end, so it looks further ahead.
    model = make_model(cars, args.seed, n_steps=256, gamma=0.99, settings=settings)
    model.policy.load_state_dict(weights)
    # It has become sure of what to do, and has to try things again: who never brakes does not find
    # out that it ends a long contact.
    with th.no_grad():
        model.policy.log_std.copy_(th.tensor([-2.0, -0.7]))
    model.learn(args.robots, callback=callbacks(env_kwargs, args, "races", 0.01, 0.002))
    cars.close()
    model.save(args.folder / "model")
    print(f"saved {args.folder}/model.zip; race it: sb3-torcs race {args.folder}/model.zip inferno")


if __name__ == "__main__":
    main()
