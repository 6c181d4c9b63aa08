"""Draw how drivers take a lap: speed, pedals and place on the road, and their lines in the bends.

python tools/compare_laps.py ddpg-aalborg inferno --track aalborg
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import sb3_torcs
from sb3_torcs.actions import BRAKE_THRESHOLD
from sb3_torcs.car import KMH
from sb3_torcs.errors import ends_in_a_line
from sb3_torcs.tracks.plot import edges

COLOURS = ("tab:blue", "tab:red", "tab:green", "tab:purple", "tab:orange")
BENDS = 3  # that are shown from above
VIEW = 70.0  # [m] around their middle
STEP = 2.0  # [m] in which the road is looked at
RADIUS = 60.0  # [m] a bend is sharper than that
BEFORE = 120.0  # [m] in which a car slows down for it


class Lap(NamedTuple):
    """The best flying lap of a driver, every 0.02 s."""

    name: str
    seconds: float
    rows: pd.DataFrame

    @property
    def distance(self):
        """[m] from the line."""
        return self.rows["distance_from_start"].to_numpy()

    @property
    def offset(self):
        """[m] from the middle of the road, left positive."""
        return self.rows["distance_from_axis"].to_numpy()

    @property
    def brake(self):
        """From 0 to 1."""
        return self.rows["brake"].to_numpy()


def tightest_bends(track):
    """Where the road bends most: distances of the middles, well apart."""
    places = np.arange(0.0, track.length, 5.0)
    heading = np.array([track.pose(place).heading for place in places])
    turn = np.abs(np.convolve(np.gradient(heading), np.ones(12), "same"))
    found = []
    for index in np.argsort(-turn):
        near = [abs(places[index] - place) for place in found]
        if all(min(gap, track.length - gap) > 3.0 * VIEW for gap in near):
            found.append(places[index])
        if len(found) == BENDS:
            return sorted(found)
    return sorted(found)


def sharp_bends(track):
    """Whether the road bends sharply, every few metres of it."""
    places = np.arange(0.0, track.length, STEP)
    curvature = [track.segments[track.find(place)[0]].curvature for place in places]
    return np.abs(curvature) > 1.0 / RADIUS


def where_it_brakes(lap, bend):
    """Shares of its time on the brake: shortly before a bend, and in one."""
    ahead = np.any([np.roll(bend, -step) for step in range(int(BEFORE / STEP))], axis=0)
    braking = (lap.distance[lap.brake > BRAKE_THRESHOLD] / STEP).astype(int) % len(bend)
    return np.mean((ahead & ~bend)[braking]), np.mean(bend[braking])


def offsets(lap, track):
    """[m] from the middle of the road, every few metres of it."""
    return np.interp(np.arange(0.0, track.length, STEP), lap.distance, lap.offset)


def draw_along(figure, laps):
    """Speed, pedals and place over the distance."""
    speed, pedals, place = figure.subplots(3, 1, sharex=True)
    for lap, colour in zip(laps, COLOURS, strict=False):
        label = f"{lap.name}, {lap.seconds:.2f} s"
        speed.plot(lap.distance, KMH * lap.rows["speed_x"], color=colour, label=label)
        pedals.plot(lap.distance, lap.rows["throttle"], color=colour, linewidth=0.8)
        pedals.fill_between(lap.distance, -lap.brake, color=colour, alpha=0.5, linewidth=0.0)
        place.plot(lap.distance, 2.0 * lap.offset / lap.rows["track_width"], color=colour)
    speed.set_ylabel("speed [km/h]")
    speed.legend(fontsize=8, ncols=len(laps), loc="lower left", bbox_to_anchor=(0.0, 1.0))
    pedals.set_ylabel("brake (down), throttle (up)")
    pedals.axhline(0.0, color="black", linewidth=0.6)
    place.set_ylabel("right edge to left edge")
    place.axhline(0.0, color="black", linewidth=0.6, linestyle="--")
    place.set_ylim(-1.05, 1.05)
    place.set_xlabel("distance from the line [m]")
    for axes in (speed, pedals, place):
        axes.grid(alpha=0.3)


def draw_bends(figure, laps, track):
    """The lines through the tightest bends, from above."""
    centre = np.array([track.pose(place)[:2] for place in np.arange(0.0, track.length, 2.0)])
    panels = figure.subplots(1, BENDS)
    for axes, place in zip(panels, tightest_bends(track), strict=False):
        x, y, _ = track.pose(place)
        for edge in edges(track):
            axes.plot(*edge.T, color="#4a4f57", linewidth=1.0)
        axes.plot(*centre.T, color="#4a4f57", linewidth=0.7, linestyle="--")
        for lap, colour in zip(laps, COLOURS, strict=False):
            axes.plot(lap.rows["x"], lap.rows["y"], color=colour, linewidth=1.8)
        axes.set(xlim=(x - VIEW, x + VIEW), ylim=(y - VIEW, y + VIEW), aspect="equal")
        axes.set_title(f"{place:.0f} m", fontsize=9)
        axes.set(xticks=[], yticks=[])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drivers", nargs="+", help="models, shipped agents or robots")
    parser.add_argument("--track", default="aalborg")
    parser.add_argument("--out", type=Path, default=Path("laps.png"))
    args = parser.parse_args()
    compared = sb3_torcs.compare(*args.drivers, track=args.track).comparison
    track = compared.track
    laps = [Lap(one.drive.driver, one.lap.time, one.lap.rows) for one in compared.drivers]
    bend = sharp_bends(track)
    for lap in laps:
        before, within = where_it_brakes(lap, bend)
        share = np.mean(lap.brake > BRAKE_THRESHOLD)
        print(
            f"{lap.name}: {lap.seconds:.3f} s, on the brake in {share:.0%} "
            f"of it; {before:.0%} of that at most {BEFORE:.0f} m before a bend, {within:.0%} in one"
        )
        line, last = offsets(lap, track), offsets(laps[-1], track)
        middle, apart = np.abs(line).mean(), np.abs(line - last).mean()
        told = f"  {middle:.2f} m from the middle of the road, {apart:.2f} m from"
        print(f"{told} {laps[-1].name}'s line")
    figure = Figure(figsize=(12.0, 11.0), layout="constrained")
    along, bends = figure.subfigures(2, 1, height_ratios=[1.7, 1.0])
    draw_along(along, laps)
    draw_bends(bends, laps, track)
    figure.savefig(args.out, dpi=100)
    print(args.out)


if __name__ == "__main__":
    with ends_in_a_line():
        main()
