"""Let a saved model drive some laps, and say how they went."""

import argparse

from sb3_torcs.agents import driver_record, load_driver
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.evaluation import evaluate, race_environment

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("model", help="a .zip, the folder of a run, or a shipped agent")
parser.add_argument("--track", default="aalborg")
parser.add_argument("--episodes", type=int, default=1)
parser.add_argument("--laps", type=int, default=3)
args = parser.parse_args()

with ends_in_a_line():
    # The environment is that of the training: its sensors, action, gearbox and wrappers.
    record = driver_record(args.model)
    env = race_environment(
        record.env_id or "TorcsLite-v0",
        record.env_kwargs,
        args.track,
        laps=args.laps,
        hyperparameters=record.hyperparameters,
    )
    driver = load_driver(args.model, env)
    for number, episode in enumerate(evaluate(env, driver, episodes=args.episodes), start=1):
        laps = ", ".join(f"{seconds:.2f} s" for seconds in episode.lap_times) or "no whole lap"
        print(f"episode {number}: {laps}; {episode.distance:.0f} m; ended by {episode.end}")
    env.close()
