"""All measurements of `sb3-torcs bench`, in the order in which they run."""

from __future__ import annotations

from collections.abc import Callable

from sb3_torcs.bench import scr, torcs
from sb3_torcs.bench.drives import Figures
from sb3_torcs.bench.environments import environments, resets
from sb3_torcs.bench.learning import training_rate, training_share
from sb3_torcs.bench.on_policy import ppo
from sb3_torcs.bench.updates import default_updates
from sb3_torcs.bench.vec_env import race, vec_env
from sb3_torcs.errors import BackendUnavailable

__all__ = ["KEYS", "stages"]


KEYS = (
    "lite_ticks_per_s",
    "racetrack_v1_steps_per_s",
    "lite_reset_ms",
    "torcs_limit_ticks_per_s",
    "torcs_cpp_ticks_per_s",
    "torcs_env_ticks_per_s",
    "torcs_env_repeat5_ticks_per_s",
    "torcs_reset_ms",
    "torcs_load_ms",
    "torcs_vector2_ratio",
    "vec_env_timesteps_per_s",
    "vec_env_two_threads_ratio",
    "race_car_ticks_per_s",
    "scr_ticks_per_s",
    "scr_reset_ms",
    "game_frames_per_s",
    "core_gflops",
    "ddpg_updates_per_s",
    "ddpg_update_gflop",
    "ddpg_two_threads_ratio",
    "ddpg_timesteps_per_s",
    "ppo_timesteps_per_s",
    "ppo_dummy_timesteps_per_s",
    "training_env_share",
)
"""All figures, in the order they are shown; those of worlds that are not here stay empty."""


def stages(seconds: float) -> dict[str, Callable[[], Figures]]:
    """
    List the measurements.

    :param seconds: to spend on all of them, about [s]
    :return: by name; each returns some of the figures
    """
    share = seconds / 7.0
    return {
        "environments": lambda: environments(share),
        "resets": resets,
        "game": _where_it_is(lambda: torcs.ticks(share)),
        "game resets": _where_it_is(torcs.resets),
        "game loads": _where_it_is(torcs.loads),
        "game threads": _where_it_is(lambda: torcs.vector(share)),
        "races at once": _where_it_is(lambda: vec_env(share)),
        "one race": _where_it_is(lambda: race(share)),
        "SCR": _where_it_is(lambda: scr.ticks(share)),
        "SCR resets": _where_it_is(scr.resets),
        "pictures": _where_it_is(scr.pictures),
        "updates": lambda: default_updates(share),
        "learning": _where_it_is(lambda: training_rate(max(int(400.0 * share), 100))),
        "PPO": _where_it_is(lambda: ppo(share)),
        "training": lambda: training_share(max(int(40.0 * share), 100)),
    }


def _where_it_is(measure: Callable[[], Figures]) -> Callable[[], Figures]:
    """Return ``None`` for figures of the game where it cannot be driven."""

    def measured() -> Figures:
        try:
            return measure()
        except BackendUnavailable:  # sb3-torcs doctor says why
            return {}

    return measured
