"""Let a saved model drive some laps, and say how they went."""

import argparse

import gymnasium as gym
from stable_baselines3 import DDPG

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.evaluation.protocol import evaluate, time_limit

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("model", help="a .zip that DDPG saved")
parser.add_argument("--track", default="aalborg")
parser.add_argument("--episodes", type=int, default=1)
parser.add_argument("--laps", type=int, default=3)
args = parser.parse_args()

model = DDPG.load(args.model, device="cpu")
env_kwargs = {"track": args.track, "laps": args.laps}
env = gym.make("TorcsLite-v0", max_episode_steps=time_limit(env_kwargs), **env_kwargs)
for number, episode in enumerate(evaluate(env, model, episodes=args.episodes), start=1):
    laps = ", ".join(f"{seconds:.2f} s" for seconds in episode.lap_times) or "no whole lap"
    print(f"episode {number}: {laps}; {episode.distance:.0f} m; ended by {episode.end}")
env.close()
