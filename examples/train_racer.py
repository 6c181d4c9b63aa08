"""Train PPO to race: first alone, then behind robots, while some cars stay alone.

Each car of each race is an environment of TorcsVecEnv, so that stock PPO learns from all of them.
It learns one track, or several, to race on those that it never saw. With --driver it goes on from a
model that drives alone already, and sees what that model sees and other cars; with --racer it goes
on from one that races. With --ancestor it goes on from either, and races against itself, this
ancestor and robots. With --weight-decay it becomes careful; with --racer it goes on from there
without, which may teach it to pass and keep some of that care.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_torcs.agents.models import find_model, training_record
from sb3_torcs.agents.saved.file import learned_weights
from sb3_torcs.agents.saved.writing import RecordCallback, recipe
from sb3_torcs.callbacks import LeanUpdatesCallback
from sb3_torcs.callbacks.adapting import AdaptiveLearningRateCallback, learn_values
from sb3_torcs.callbacks.progress import RacingProgressCallback
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.sensors import feature_slices
from sb3_torcs.vec_env import JoinedVecEnv, MirrorVecEnv, TorcsVecEnv

FROM_NOTHING = {
    "sensors": ["base", "line", "motion", "rivals"], "range_finders": "narrow", "action": "pedal",
    "gearbox": "road_speed", "action_repeat": 5,
}  # fmt: skip
"""How a racer drives that learns from nothing."""
# The fields of robots, of which each race draws one. Those with a number drive another car.
FIELDS = (
    ("berniw", "bt", "inferno", "lliaw", "olethros", "tita", "inferno:4"),
    ("inferno:4", "bt:3", "tita:4", "lliaw:4", "berniw", "olethros", "tita"),
    ("lliaw", "olethros", "tita", "inferno:4", "bt", "tita:4", "berniw"),
    ("tita", "bt", "berniw"),
)
UNITS = [128, 128]  # of a new policy


@dataclass(frozen=True)
class Settings:
    """What differs between a racer for one track and one for all roads."""

    timesteps_alone: int
    cars_alone: int  # at once, before they meet others
    beside_races: int  # cars alone per race
    episode: int  # timesteps of a car alone
    speed: float  # of a car alone at the beginning of an episode, at most [m/s]
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


@dataclass(frozen=True)
class Steps:
    """How far a policy may go from what it knows."""

    rate: float  # factor on the learning rate at the beginning, from which it adapts
    kl: float  # target of the divergence per update, at the beginning [nats]
    last_kl: float  # at the end [nats]
    log_std: tuple[float, float]  # of steering and pedal, with which it tries things at first


ALONE = Steps(1.0, 0.012, 0.003, (-1.0, -0.3))  # of who does not know how to drive
BIG_STEPS = Steps(1.0, 0.01, 0.002, (-2.0, -0.7))  # of who has just learned to drive
SMALL_STEPS = Steps(0.03, 0.006, 0.001, (-2.3, -1.0))  # of a model that drives or races well


@dataclass(frozen=True)
class Races:
    """How agents race."""

    agents: int  # in each race, one behind the other
    fields: Sequence[Sequence[str]]  # the others, of which each race draws one
    places: list[int | None]  # on the grid, of the first agent; None is behind all others
    limits: list[int]  # on the timesteps of an episode
    aids: tuple[str, ...]  # by which cars brake and steer by themselves
    reward: dict[str, float]  # weights that differ between the two kinds of races


BEHIND_ROBOTS = Races(
    agents=3, fields=FIELDS, places=[None],
    limits=[450, 450, 1400],  # damage is done in the crowd of the first minute
    aids=("unstick", "keep_distance", "keep_clear", "catch_slides"),
    reward={"damage": -0.3, "places": 20.0, "fault": -10.0, "crash": -1.0},
)  # fmt: skip


def against(ancestor: str) -> Races:
    """
    Tell how agents race against an ancestor, which is as fast as they are.

    Who keeps a distance stays behind, so they do not.
    """
    fields = (
        (ancestor, ancestor), (ancestor, "bt"), (ancestor, "inferno", "bt"),
        ("berniw", ancestor, "inferno"),
    )  # fmt: skip
    return Races(
        agents=2, fields=fields, places=[1, 2, 3], limits=[450, 1400, 1400],
        aids=("unstick", "keep_clear", "catch_slides"),
        reward={"damage": -0.1, "places": 50.0, "fault": -3.0, "crash": -10.0},
    )  # fmt: skip


def reward_alone(settings: Settings, args: argparse.Namespace) -> dict[str, float]:
    """Return the weights of the reward's terms for a car that is alone."""
    return {
        "progress": 1.0, "off_line": settings.off_line[0], "leaving": -0.5, "damage": -0.02,
        "crash": -1.0, "sliding": -args.sliding, "scale": 0.1,
    }  # fmt: skip


def reward_in_races(settings: Settings, races: Races, args: argparse.Namespace) -> dict[str, float]:
    """Return the weights of the reward's terms for a car among others."""
    damage = {} if args.damage is None else {"damage": -args.damage}
    return {
        "progress": 1.0, "off_line": settings.off_line[1], "leaving": -0.3, "passing": 1.0,
        "contact": -1.0, **races.reward, **damage, "sliding": -args.sliding, "scale": 0.1,
    }  # fmt: skip


parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--track", nargs="+", default=["aalborg"], help="one, or several")
parser.add_argument("--alone", type=int, help="timesteps without other cars")
parser.add_argument("--robots", type=int, default=6_000_000, help="timesteps in races")
parser.add_argument("--driver", help="model that drives alone, to go on from, such as ppo-any-road")
parser.add_argument("--racer", help="model that races, to go on from, such as ppo-racer")
parser.add_argument("--ancestor", help="model to go on from, and to race against")
parser.add_argument(
    "--values",
    type=int,
    default=400_000,
    help="timesteps in which only the value function learns, if the driver's file has none",
)
parser.add_argument(
    "--weight-decay",
    type=float,
    default=0.0,
    metavar="W",
    help="of the optimizer, such as 0.0003, by which racers become careful; default: none",
)
parser.add_argument(
    "--damage",
    type=float,
    metavar="P",
    help="what a point of damage costs in races; default: 0.3, and 0.1 with --ancestor",
)
parser.add_argument(
    "--sliding",
    type=float,
    default=0.0,
    metavar="P",
    help="what each metre per second across the car costs, such as 0.5; default: nothing",
)
parser.add_argument("--races", type=int, default=16, help="held at once")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--threads", type=int, help="default: one per core")
parser.add_argument("--folder", type=Path, default=Path("logs/racer"))


def make_model(
    env: VecEnv,
    args: argparse.Namespace,
    n_steps: int,
    gamma: float,
    settings: Settings,
    units: Sequence[int],
) -> PPO:
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
            "net_arch": list(units),
            "activation_fn": nn.ReLU,
            "log_std_init": list(ALONE.log_std),
            "optimizer_kwargs": {"eps": 1e-5, "weight_decay": args.weight_decay},  # SB3's own eps
        },
        seed=args.seed,
        device="cpu",
    )


def callbacks(
    env_kwargs: dict, args: argparse.Namespace, stage: str, steps: Steps
) -> list[BaseCallback]:
    """Save models with what `sb3-torcs race` has to know of their training."""
    asked = recipe("ppo", "Torcs-v0", {"env_kwargs": env_kwargs})
    every = CheckpointCallback(4096, str(args.folder), name_prefix=stage)  # timesteps of each car
    adaptive = AdaptiveLearningRateCallback(
        kl=steps.kl, last_kl=steps.last_kl, first_factor=steps.rate
    )
    return [RecordCallback(asked), RacingProgressCallback(), LeanUpdatesCallback(), adaptive, every]


def cars_alone(
    number: int, args: argparse.Namespace, env_kwargs: dict, settings: Settings
) -> TorcsVecEnv:
    """Make cars that begin anywhere on the road, many of them where others left it before."""
    cars = TorcsVecEnv(
        number,
        threads=args.threads,
        reward=reward_alone(settings, args),
        start="random",
        max_episode_steps=settings.episode,
        conditions={"grip": settings.grip},
        **env_kwargs,
    )
    cars.env_method("set_random_speed", settings.speed)
    cars.env_method("set_hard_starts", settings.hard)
    return cars


def mirrored(cars: VecEnv, settings: Settings) -> VecEnv:
    """Let every other car drive on the mirror image of its road, if that is wanted."""
    return MirrorVecEnv(cars) if settings.mirror else cars


def cars_in_races(
    args: argparse.Namespace, env_kwargs: dict, settings: Settings, races: Races
) -> TorcsVecEnv:
    """
    Make races that begin on the grid.

    A start elsewhere would let each robot plan its line anew. A car that spins, or is pushed off
    the road, learns to come back to it.
    """
    return TorcsVecEnv(
        args.races,
        agents=races.agents,
        threads=args.threads,
        reward=reward_in_races(settings, races, args),
        opponents=races.fields,
        grid_place=races.places,
        ends={"runoff": 8.0, "recovery": 20.0},
        max_episode_steps=races.limits,
        **env_kwargs,
    )


def learn_alone(args: argparse.Namespace, env_kwargs: dict, settings: Settings) -> dict:
    """Learn to drive where there is nobody, and return the policy's weights."""
    cars = mirrored(cars_alone(settings.cars_alone, args, env_kwargs, settings), settings)
    model = make_model(cars, args, 128, 0.985, settings, UNITS)
    timesteps = settings.timesteps_alone if args.alone is None else args.alone
    model.learn(timesteps, callback=callbacks(env_kwargs, args, "alone", ALONE))
    cars.close()
    return model.policy.state_dict()


def with_values(
    weights: dict, cars: VecEnv, args: argparse.Namespace, settings: Settings, units: Sequence[int]
) -> dict:
    """
    Let the value function learn first if the weights have none, as those of a student.

    Updates by a value function that knows nothing would spoil the policy.
    """
    if "value_net.weight" in weights:
        return weights
    model = make_model(cars, args, 256, 0.99, settings, units)
    model.policy.load_state_dict({**model.policy.state_dict(), **weights})
    learn_values(model, args.values)
    return model.policy.state_dict()


def begin_to_race(weights: dict, sensors: Sequence[str]) -> None:
    """
    Let a policy that has never met a car see others without fright.

    Alone it saw zeros for rivals, so the weights of theirs are those that it was born with. A
    driver that never saw them has none.
    """
    features = feature_slices(sensors)
    size = max(where.stop for where in features.values())
    others = th.ones(size, dtype=th.bool)
    for sensor, where in features.items():
        others[where] = "rivals" not in sensor
    for net in ("policy_net", "value_net"):
        name = f"mlp_extractor.{net}.0.weight"
        if name not in weights:
            continue
        known = weights[name]
        if known.shape[1] not in (others.sum(), size):
            raise SystemExit(
                "the driver sees several timesteps at once, or other sensors than its record "
                "says; take another one, such as ppo-any-road"
            )
        weights[name] = known.new_zeros(len(known), size)
        weights[name][:, others] = known[:, others] if known.shape[1] == size else known


def how_to_drive(known: str | None) -> dict:
    """
    Tell how a racer drives: as the model from which it goes on, and seeing other cars.

    :param known: the model's name or path
    """
    if known is None:
        return FROM_NOTHING
    record = training_record(find_model(known))
    drives = {"sensors": ["base"], "action": "pedals", **record.select(FROM_NOTHING)}
    advice = 'take a model of PPO with action="pedal" and BoundedPolicy, such as ppo-any-road'
    if drives["action"] != "pedal":
        raise SystemExit(f"'{known}' drives with action=\"{drives['action']}\"; {advice}")
    policy = "none that is known" if record.policy is None else record.policy["class"]
    if not policy.endswith("BoundedPolicy"):
        raise SystemExit(f"the policy of '{known}' is {policy}; {advice}")
    drives["sensors"] = [*dict.fromkeys((*drives["sensors"], "rivals"))]
    return drives


def has_raced(args: argparse.Namespace) -> bool:
    """Tell whether the model from which a racer goes on has met other cars."""
    if args.ancestor is None:
        return args.racer is not None
    return "rivals" in training_record(find_model(args.ancestor)).env_kwargs.get("sensors", ())


def main() -> None:
    args = parser.parse_args()
    several = len(args.track) > 1
    # Against an equal pace counts most. Less grip costs it, and so does a high price of leaving
    # the racing line.
    settings = ALL_ROADS if several and not args.ancestor else ONE_TRACK
    races = against(args.ancestor) if args.ancestor else BEHIND_ROBOTS
    known = args.ancestor or args.racer or args.driver
    env_kwargs = {
        "track": args.track if several else args.track[0], **how_to_drive(known),
        "aids": races.aids,
    }  # fmt: skip
    weights = (
        learned_weights(find_model(known)) if known else learn_alone(args, env_kwargs, settings)
    )
    if not has_raced(args):
        begin_to_race(weights, env_kwargs["sensors"])
    units = [len(weights[f"mlp_extractor.policy_net.{layer}.bias"]) for layer in (0, 2)]

    # Some cars stay alone, for the pace: in races they are seldom free to drive at their own.
    beside = cars_alone(settings.beside_races * args.races, args, env_kwargs, settings)
    cars = mirrored(
        JoinedVecEnv([cars_in_races(args, env_kwargs, settings, races), beside]), settings
    )
    # Damage comes seldom and in heaps, so that short rollouts would lead astray. To follow a slower
    # car costs little at once, and much in the end, so it looks further ahead.
    weights = with_values(weights, cars, args, settings, units)
    steps = SMALL_STEPS if known else BIG_STEPS
    model = make_model(cars, args, 256, 0.99, settings, units)
    model.policy.load_state_dict(weights)
    # It has become sure of what to do, and has to try things again: who never brakes does not find
    # out that it ends a long contact.
    with th.no_grad():
        model.policy.log_std.copy_(th.tensor(steps.log_std))
    model.learn(args.robots, callback=callbacks(env_kwargs, args, "races", steps))
    cars.close()
    model.save(args.folder / "model")
    print(f"saved {args.folder}/model.zip; race it: sb3-torcs race {args.folder}/model.zip inferno")


if __name__ == "__main__":
    with ends_in_a_line():
        main()
