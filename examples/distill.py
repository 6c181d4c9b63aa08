"""Teach one policy what several agents know, each on tracks of its own.

The student drives, and learns what the teacher of its track would do where it is (DAgger: Ross,
Gordon and Bagnell, arXiv:1011.0686). A track that is named several times gets more cars.
`specialize.py` makes teachers for tracks that no agent drives well. Several models, with commas
between them, teach the mean of their actions.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch as th
from rich.progress import track as progress
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_torcs.agents.models import driver_record, find_model, training_record
from sb3_torcs.agents.saved.file import learned_weights
from sb3_torcs.agents.saved.record import DRIVEN_WITH
from sb3_torcs.agents.saved.writing import recipe, write_record
from sb3_torcs.agents.wrapping import frames_of
from sb3_torcs.car import DEFAULT_CAR, check_count
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.policies.imitation import Imitation, mean_actions
from sb3_torcs.vec_env import JoinedVecEnv, MirrorVecEnv, TorcsVecEnv

TIMESTEPS = 64  # of each car, between lessons
BATCH = 4096  # observations in a lesson, which is a step of Adam
RATE = 1e-3  # of learning, which falls in the second half
LAST = 10  # times as many lessons in the last round
KEPT = 20  # rounds after which a copy is kept
SHOWN = 0.15  # of the rounds, in which teachers still drive, less and less

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument(
    "--teach",
    nargs="+",
    action="append",
    required=True,
    metavar=("TEACHER", "TRACK"),
    help="a model of PPO, or several with commas between them, and the tracks on which they teach; "
    "give it once per teacher",
)
parser.add_argument("--student", help="a model of PPO to go on from")
parser.add_argument("--rounds", type=int, default=150, help="of driving and lessons")
parser.add_argument("--lessons", type=int, default=40, help="in each round")
parser.add_argument("--cars", type=int, default=4, help="on each track")
parser.add_argument("--grip", type=float, default=1.0, help="least grip, of that of the game")
parser.add_argument("--mirror", action="store_true", help="let every other car drive in the mirror")
parser.add_argument("--width", type=int, default=256, help="of a new student's two layers")
parser.add_argument(
    "--actor-sensors", nargs="+", help="groups of sensors that a new student sees; default: all"
)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--threads", type=int, help="default: one per core")
parser.add_argument("--folder", type=Path, default=Path("logs/distilled"))


class School:
    """
    Cars on the tracks of their teachers.

    :param args: from the command line
    """

    def __init__(self, args: argparse.Namespace) -> None:
        teaching = [(names.split(","), tracks) for names, *tracks in args.teach]
        for names, tracks in teaching:
            if not tracks:
                raise SystemExit(f"{','.join(names)} teaches nowhere; name its tracks behind it")
        self.env_kwargs = _same_for_all([name for names, _ in teaching for name in names])
        self.tracks = list(dict.fromkeys(track for _, tracks in teaching for track in tracks))
        self._teachers = [[_policy(name) for name in names] for names, _ in teaching]
        parts = []
        for _, tracks in teaching:
            part = TorcsVecEnv(
                args.cars * len(tracks),
                threads=args.threads,
                track=tracks,
                start="random",
                max_episode_steps=300,
                conditions={"grip": [args.grip, 1.0]},
                **self.env_kwargs,
            )
            part.env_method("set_random_speed", 80.0)
            part.env_method("set_hard_starts", 0.7)
            parts.append(part)
        self._sizes = [part.num_envs for part in parts]
        cars = JoinedVecEnv(parts)
        self.cars = MirrorVecEnv(cars) if args.mirror else cars

    def wanted(self, seen: th.Tensor) -> th.Tensor:
        """Ask the teachers what they would do."""
        parts = zip(self._teachers, seen.split(self._sizes), strict=True)
        return th.cat(
            [
                th.stack([mean_actions(policy, part) for policy in policies]).mean(0)
                for policies, part in parts
            ]
        )


def _same_for_all(teachers: Sequence[str]) -> dict:
    """Return the options of driving, which all teachers have to share."""
    found = [
        {"car": DEFAULT_CAR, **driver_record(teacher).select(("car", *DRIVEN_WITH))}
        for teacher in teachers
    ]
    for teacher, options in zip(teachers, found, strict=True):
        if options != found[0]:
            raise SystemExit(f"{teacher} drives with {options}, and {teachers[0]} with {found[0]}")
    return found[0]


def _policy(name: str) -> ActorCriticPolicy:
    """Load the policy of a teacher."""
    file = find_model(name)
    if training_record(file).algo != "ppo":
        raise SystemExit(f"{name} is no model of PPO; give one, e.g. ppo-any-road")
    if driver_record(name).env_kwargs.get("action") != "pedal":
        raise SystemExit(f'{name} does not drive with action="pedal"; give one, e.g. ppo-any-road')
    refuse_frames(name)
    return PPO.load(file, device="cpu").policy


def refuse_frames(name: str) -> None:
    """Refuse an agent that sees several timesteps at once, which a school does not show."""
    frames = frames_of(driver_record(name).hyperparameters) or 1
    if frames > 1:
        raise SystemExit(f"{name} sees {frames} timesteps at once; give another, e.g. ppo-any-road")


def teach(model: PPO, school: School, args: argparse.Namespace) -> None:
    """Drive and learn, in rounds; everything that was seen is kept."""
    rounds = args.rounds
    student: ActorCriticPolicy = model.policy
    imitation = Imitation(student, RATE)
    rng = np.random.default_rng(args.seed)
    cars = school.cars
    cars.seed(args.seed)
    last_seen = cars.reset()
    number, features = last_seen.shape
    seen = th.empty(rounds * TIMESTEPS * number, features)
    wanted = th.empty(len(seen), 2)
    known = 0
    for done in progress(range(rounds), description="teaching"):
        shown = rng.random(number) < (0.0 if args.student else 1.0 - done / (SHOWN * rounds))
        for _ in range(TIMESTEPS):
            now = slice(known, known + number)
            seen[now] = th.from_numpy(last_seen)
            wanted[now] = school.wanted(seen[now])
            own = mean_actions(student, seen[now])
            last_seen, *_ = cars.step(np.where(shown[:, None], wanted[now], own))
            known += number
        imitation.set_learning_rate(RATE * min(1.0, 2.0 * (1.0 - done / rounds)))
        for _ in range(args.lessons * (1 if done < rounds - 1 else LAST)):
            batch = th.from_numpy(rng.integers(0, known, BATCH))
            imitation.learn(seen[batch], wanted[batch])
        if done % KEPT == KEPT - 1:
            model.save(args.folder / f"{done + 1}_rounds")


def main() -> None:
    args = parser.parse_args()
    check_count("--rounds", args.rounds)
    if args.student:
        refuse_frames(args.student)
    school = School(args)
    policy_kwargs = {
        "net_arch": [args.width, args.width],
        "activation_fn": nn.ReLU,
        "log_std_init": [-2.0, -0.7],  # steering, pedal, for a training that goes on from it
        "actor_sensors": args.actor_sensors,
    }
    file = find_model(args.student) if args.student else None
    known = PPO.load(file, device="cpu") if file else None
    model = PPO(
        BoundedPolicy,
        school.cars,
        policy_kwargs=known.policy_kwargs if known else policy_kwargs,
        seed=args.seed,
        device="cpu",
    )
    if file:
        model.policy.load_state_dict({**model.policy.state_dict(), **learned_weights(file)})
    env_kwargs = {**school.env_kwargs, "track": school.tracks}
    write_record(model, recipe("ppo", "Torcs-v0", {"env_kwargs": env_kwargs}))
    args.folder.mkdir(parents=True, exist_ok=True)
    teach(model, school, args)
    school.cars.close()
    model.save(args.folder / "model")
    drive = f"sb3-torcs evaluate {args.folder}/model.zip --track {school.tracks[0]}"
    cars = env_kwargs["car"]
    drive += f" --car {cars[0]}" if isinstance(cars, list) else ""
    print(f"saved {args.folder}/model.zip; drive it: {drive}")


if __name__ == "__main__":
    with ends_in_a_line():
        main()
