"""``sb3-torcs bench``: how fast everything is on this machine."""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any

from sb3_torcs.cli.common import print_json, quiet_output, table

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Measure speeds on one core, in processor time. Figures to be compared are measured in turns.

lite_ticks_per_s          env.step of TorcsLite-v0, action_repeat=1, without resets; a scripted
                          driver has chosen the actions beforehand
racetrack_v1_steps_per_s  env.step of highway-env's racetrack-v1
lite_reset_ms             resets of TorcsLite-v0
torcs_limit_ticks_per_s   the game's bare physics, along a recorded drive
torcs_cpp_ticks_per_s     the same drive in the engine, with rules and sensors
torcs_env_*               the same drive by env.step of Torcs-v0
torcs_reset_ms            resets of Torcs-v0, to the grid and to random positions in turns
torcs_load_ms             gym.make on the track that takes longest
torcs_vector2_ratio       the gain by a second thread in gym.make_vec with 16 races, divided by the
                          gain by a second process with bare engines
vec_env_timesteps_per_s   TorcsVecEnv on one thread: 16 races of Torcs-v0, five ticks per timestep
vec_env_two_threads_ratio the gain by a second thread in the same, at best
race_car_ticks_per_s      TorcsVecEnv on one thread: ticks of all cars of a race of eight agents,
                          five per timestep
scr_ticks_per_s           env.step with backend="scr", five ticks per timestep
scr_reset_ms              resets with backend="scr"
game_frames_per_s         picture="game" at 640x480
policy_*                  updates of a DDPG with SplitHeadPolicy, batch size 64
core_gflops               matrix products of 64 x 256 x 256, best turn
ddpg_updates_per_s        updates of the default DDPG entry of Torcs-v0, best turn
ddpg_update_gflop         arithmetic of such an update, its matrix products alone
ddpg_two_threads_ratio    the gain by a second thread in such updates, best turns
ddpg_timesteps_per_s      timesteps of a training with that entry, after its beginning
ppo_timesteps_per_s       timesteps of PPO's training with its entry of Torcs-v0 on two cores, in
                          TorcsVecEnv, best rollout with its update
ppo_dummy_timesteps_per_s the same hyperparameters in DummyVecEnv, with SB3's own updates
training_env_share        share of a DDPG training (shipped hyperparameters) that the environment
                          and the callbacks take

torcs_vector2_ratio, *_two_threads_ratio, ppo_*, scr_* and game_frames_per_s are measured by the
wall clock, since several processes or threads work. A figure that cannot be measured on this
machine is null.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "bench",
        help="measure speeds",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object and nothing else"
    )
    parser.add_argument(
        "--seconds", type=float, default=30.0, metavar="S", help="for about so long; default: 30"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from tqdm import tqdm

    from sb3_torcs.bench.stages import KEYS, stages
    from sb3_torcs.errors import InvalidOption

    if not 0.0 < args.seconds < math.inf:
        raise InvalidOption(f"--seconds is {args.seconds:g}; expected more than 0, e.g. 30")
    figures: dict[str, float | None] = dict.fromkeys(KEYS)
    measurements = stages(args.seconds)
    with (
        quiet_output(args.json),
        tqdm(total=len(measurements), file=sys.stderr, leave=False, disable=None) as bar,
    ):
        for name, measure in measurements.items():
            bar.set_description(name)
            figures.update(measure())
            bar.update()
    if args.json:
        print_json(figures)
        return 0
    print(table(("figure", "value"), [(name, _number(value)) for name, value in figures.items()]))
    return 0


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.5g}" if value < 1000.0 else f"{value:.0f}"
