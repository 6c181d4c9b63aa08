"""Nothing stays behind: no memory, no descriptors, no files.

``python tests/test_torcs_memory.py`` makes 100,000 resets and 1,000 races, which takes minutes.
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

TORCS = "sb3_torcs:Torcs-v0"
TRACKS = ("aalborg", "michigan", "spring")
GAS = np.array([0.1, 1.0, 0.0], np.float32)
FLAT = 5e6  # [bytes] that the process may grow by after a warm-up


def resident():
    """Memory of this process [bytes], when all that is garbage is gone."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def descriptors():
    return len(os.listdir("/proc/self/fd"))


def mappings():
    return len(Path("/proc/self/maps").read_text(encoding="utf-8").splitlines())


def growth(turn, number):
    """How much memory, descriptors and mappings grow by many turns, after a tenth as warm-up."""
    for i in range(max(number // 10, 2 * len(TRACKS))):
        turn(i)
    before = resident(), descriptors(), mappings()
    for i in range(number):
        turn(i)
    after = resident(), descriptors(), mappings()
    return tuple(b - a for a, b in zip(before, after, strict=True))


def by_resets(number):
    env = gym.make(TORCS)
    env.reset(seed=0)

    def turn(i):
        env.unwrapped.set_start("random" if i % 2 else "grid")
        env.reset()
        env.step(GAS)

    try:
        return growth(turn, number)
    finally:
        env.close()


def by_races(number):
    def turn(i):
        env = gym.make(TORCS, track=TRACKS[i % len(TRACKS)])
        env.reset(seed=i)
        env.step(GAS)
        env.close()

    return growth(turn, number)


def by_vectors(number):
    def turn(i):
        envs = gym.make_vec(TORCS, num_envs=2, threads=2)
        envs.reset(seed=i)
        envs.step(np.stack([GAS, GAS]))
        envs.close()

    return growth(turn, number)


@pytest.mark.usefixtures("game")
@pytest.mark.parametrize(("kind", "number"), [(by_resets, 2000), (by_races, 24), (by_vectors, 24)])
def test_nothing_stays_behind(kind, number, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    memory, files, maps = kind(number)
    assert memory < FLAT
    assert (files, maps < 20) == (0, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("game")
def test_open_races_hold_no_descriptors():
    """A race has a copy of each module; 100 races of ten cars would pass the usual limit."""
    gym.make(TORCS, opponents=["inferno", "bt"]).close()
    before = descriptors()
    envs = [gym.make(TORCS, opponents=["inferno", "bt"]) for _ in range(4)]
    for env in envs:
        env.reset(seed=0)
    assert descriptors() == before
    for env in envs:
        env.close()


if __name__ == "__main__":
    for kind, number in ((by_resets, 100_000), (by_races, 1000), (by_vectors, 300)):
        memory, files, maps = kind(number)
        print(f"{number} {kind.__name__}: {memory / 1e6:+.2f} MB, {files:+d} files, {maps:+d} maps")
        sys.stdout.flush()
