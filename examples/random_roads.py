"""Write random roads as files of TORCS, for Torcs-v0: tracks that nobody has ever seen."""

import argparse
from pathlib import Path

import numpy as np

from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.tracks.generator import random_track
from sb3_torcs.tracks.torcs_xml_writer import write_track_xml

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("folder", type=Path, help="for the files random-0.xml and so on")
parser.add_argument("--number", type=int, default=40, help="of roads; each is its own seed")

if __name__ == "__main__":
    with ends_in_a_line():
        args = parser.parse_args()
        args.folder.mkdir(parents=True, exist_ok=True)
        for seed in range(args.number):
            road = random_track(np.random.default_rng(seed))
            write_track_xml(road, args.folder / f"random-{seed}.xml")
        print(f"{args.number} roads are in {args.folder}")
