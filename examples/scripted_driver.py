"""Lap the bundled tracks with a driver that never learned: the yardstick for those that do."""

import argparse

import gymnasium as gym

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.agents.scripted import ScriptedDriver
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.evaluation.protocol import evaluate
from sb3_torcs.tracks.catalogue import available_tracks

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--track", help="one track; without it, every bundled one")
parser.add_argument("--laps", type=int, default=1)
args = parser.parse_args()

with ends_in_a_line():
    bundled = [track.name for track in available_tracks() if track.source == "bundled"]
    for track in [args.track] if args.track else bundled:
        env = gym.make(
            "TorcsLite-v0", track=track, laps=args.laps, max_episode_steps=6000 * args.laps
        )
        (episode,) = evaluate(env, ScriptedDriver())
        laps = ", ".join(f"{seconds:.2f} s" for seconds in episode.lap_times) or "no whole lap"
        print(f"{track}: {laps}; {episode.distance:.0f} m; ended by {episode.end}")
        env.close()
