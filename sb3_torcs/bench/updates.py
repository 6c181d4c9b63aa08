"""Updates of the default DDPG entry, compared with what their arithmetic alone would take."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import DDPG

from sb3_torcs import cores
from sb3_torcs.bench.drives import Figures
from sb3_torcs.bench.policy import SpacesOnly, fill
from sb3_torcs.policies import SplitHeadPolicy
from sb3_torcs.policies.mirrored_replay import sample_mirrored
from sb3_torcs.policies.threads import one_thread
from sb3_torcs.policies.updates import LeanUpdates
from sb3_torcs.training.zoo import config_file, read_entry

__all__ = ["default_model", "default_updates", "products_of_an_update"]

PRODUCT = (64, 256, 256)
"""Sizes of the matrix product whose rate is the core's: that of the default critics."""

OF_AN_UPDATE = ("batch_size", "gamma", "tau", "n_steps", "policy_kwargs")
"""What of the entry changes the cost of an update."""

PRODUCTS_PER_TURN = 200
UPDATES_PER_TURN = 20
"""What is measured between two readings of the clock; short, so that both meet one machine."""


def default_updates(seconds: float) -> Figures:
    """
    Measure updates as the default entry makes them, and products, in turns, on one core.

    :param seconds: [s] processor time to spend on one core, at least; half as much on two threads
    :return: ``core_gflops``, ``ddpg_updates_per_s``, both of the best turn, and
        ``ddpg_update_gflop``; and ``ddpg_two_threads_ratio``, the best rate of updates on two
        threads divided by the best on one, both by the wall clock; ``None`` on a single core
    """
    entry = read_entry(config_file("ddpg"), "Torcs-v0")
    model = default_model(entry)
    updates = LeanUpdates(model)
    with cores.at_most(1), one_thread():
        figures = _on_one_core(updates, entry["policy_kwargs"], seconds)
    return {**figures, "ddpg_two_threads_ratio": _gain(updates, seconds)}


def _on_one_core(updates: LeanUpdates, policy_kwargs: dict[str, Any], seconds: float) -> Figures:
    batch_size = updates.model.batch_size
    rows, inner, columns = PRODUCT
    a, b, out = th.rand(rows, inner), th.rand(inner, columns), th.empty(rows, columns)

    def multiply() -> None:
        for _ in range(PRODUCTS_PER_TURN):
            th.mm(a, b, out=out)

    turns: tuple[Callable[[], Any], Callable[[], Any]] = (
        multiply,
        lambda: updates.train(UPDATES_PER_TURN, batch_size),
    )
    spent: tuple[list[float], list[float]] = ([], [])
    for turn in turns:  # compiles
        turn()
    while sum(map(sum, spent)) < seconds:
        for turn, times in zip(turns, spent, strict=True):
            begin = time.process_time()
            turn()
            times.append(time.process_time() - begin)
    products, update = (min(times) for times in spent)
    return {
        "core_gflops": 2e-9 * rows * inner * columns * PRODUCTS_PER_TURN / products,
        "ddpg_updates_per_s": UPDATES_PER_TURN / update,
        "ddpg_update_gflop": 2e-9 * batch_size * products_of_an_update(policy_kwargs),
    }


def _gain(updates: LeanUpdates, seconds: float) -> float | None:
    """Compare turns of updates on two threads with turns on one."""
    if cores.number() == 1:
        return None
    spent: dict[int, list[float]] = {1: [], 2: []}
    while sum(map(sum, spent.values())) < seconds / 2:
        for number, times in spent.items():
            with cores.at_most(number):
                begin = time.perf_counter()
                updates.train(UPDATES_PER_TURN, updates.model.batch_size)
                times.append(time.perf_counter() - begin)
    return min(spent[1]) / min(spent[2])


def default_model(entry: dict[str, Any]) -> DDPG:
    """
    Make the model of an entry for DDPG, with random transitions and mirrored batches.

    :param entry: of a hyperparameter file
    :return: a model that can be updated at once
    """
    model = DDPG(
        SplitHeadPolicy,
        SpacesOnly(),
        **{name: entry[name] for name in OF_AN_UPDATE},
        buffer_size=int(entry["buffer_size"]),
        seed=0,
        device="cpu",
    )
    fill(model)
    buffer = model.replay_buffer
    assert buffer is not None
    buffer.sample = partial(sample_mirrored, buffer)  # type: ignore[method-assign]
    return model


def products_of_an_update(policy_kwargs: dict[str, Any]) -> int:
    """
    Count the multiplications of matrix products in an update, per row of the batch.

    :param policy_kwargs: of ``SplitHeadPolicy``, with two layers for the actor
    :return: number of multiply-adds
    """
    observation, actions = SpacesOnly.observation_space.shape[0], 3
    first, second = policy_kwargs["net_arch"]["pi"]
    actor = np.array([observation * first, first * second, second * actions])
    one, two = policy_kwargs["net_arch"]["qf"]
    critic = np.array([observation * one, one * two, actions * two, two * two, two])
    # Forward: target, critic, and the first one for the actor. Backward: the gradients of the
    # weights, of what the second and the third layer take, and from the value to the actions.
    critics = policy_kwargs["n_critics"] * (3 * critic.sum() + critic[[1, 3, 4]].sum())
    for_actor = critic.sum() + critic[2:].sum()
    return int(critics + for_actor + 3 * actor.sum() + actor[1:].sum())
