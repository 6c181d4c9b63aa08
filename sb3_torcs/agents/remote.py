"""An agent that drives in the game itself, over the SCR protocol."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium as gym

from sb3_torcs.agents.models import driver_name, driver_record, load_driver
from sb3_torcs.agents.rollout import drive
from sb3_torcs.agents.wrapping import wrap_env
from sb3_torcs.envs.aids import NEED_RIVALS
from sb3_torcs.errors import ModelMismatch
from sb3_torcs.sensors import NEEDS_CAR, NEEDS_RACE
from sb3_torcs.telemetry import DriveLabel, DriveLog
from sb3_torcs.tracks.catalogue import stable_name

__all__ = ["Agent", "check_observable"]


def check_observable(driver: str, options: Mapping[str, Any], advice: str) -> None:
    """
    Refuse an agent that needs more than the SCR protocol tells.

    :param driver: its name
    :param options: of ``Torcs-v0``, with which it drives
    :param advice: what to do instead
    :raises ModelMismatch: if it sees other cars or its car's file, or has aids that do
    """
    untold = sorted((NEEDS_RACE | NEEDS_CAR).intersection(options.get("sensors", ())))
    untold += [aid for aid in NEED_RIVALS if aid in options.get("aids", ())]
    if untold:
        raise ModelMismatch(
            f"'{driver}' drives with {', '.join(map(repr, untold))}, for which the game's "
            f"server tells too little; {advice}"
        )


class Agent:
    """
    A saved model that drives over the SCR protocol.

    :param model: what :func:`~sb3_torcs.agents.models.load_driver` loads
    :param settings: of ``Torcs-v0`` with ``backend="scr"``: ``host``, ``port``, ``track`` and so on
    :param algo: of the model, if it cannot be inferred
    :param trust: run code that is pickled in the model
    :param name: of the driver, for the game's boards and results
    :raises ModelMismatch: if the model does not fit
    :raises ModelNotTrusted: if it takes more than plain data
    """

    def __init__(
        self,
        model: str,
        settings: Mapping[str, Any],
        algo: str | None = None,
        trust: bool = False,
        name: str = "",
    ) -> None:
        bare = gym.make("sb3_torcs:Torcs-v0", backend="scr", max_episode_steps=-1, **settings)
        self.env = wrap_env(bare, driver_record(model).hyperparameters, trust=trust)
        racing: Any = self.env.unwrapped
        racing.warns_after_end = False  # it drives on beside the road, too
        self.driver = load_driver(model, self.env, algo, trust)
        self.backend.driver_name = name
        track = stable_name(self.backend.track)
        self._label = DriveLabel(driver_name(model), track, self.backend.car, "Torcs-v0")
        self.log: DriveLog | None = None
        """What notes each timestep, once it is set."""
        self.error: BaseException | None = None
        """What went wrong, where the agent drives in a thread."""
        with self.backend.rehearsal():  # first calls are too slow for a race
            self._race(None)
        self._forget()

    @property
    def backend(self) -> Any:
        """The connection."""
        return self.env.get_wrapper_attr("backend")

    def drive(self, aftermath: float | None = None) -> None:
        """
        Drive to the end of the race, and also in its restarts.

        :param aftermath: drive on for so long after leaving the road, standing and so on, and then
            stop [s]; ``None`` drives on whatever happens
        :raises ServerLost: if the server is gone
        """
        try:
            self._race(aftermath)
            while self.backend.restarted:
                self._race(aftermath)
        finally:
            self.env.close()

    def _forget(self) -> None:
        """Reset the counts."""
        self.lap_times: list[float] = []
        """[s] of each whole lap."""
        self.distance = 0.0
        """[m] driven."""
        self.end: str | None = None
        """Why the drive ended, as in ``info``; ``None`` while it goes on, or if the race ended."""
        self.end_time: float | None = None
        """[s] of the race when that was."""

    def _race(self, aftermath: float | None) -> None:
        """Drive until the race ends, or as ``drive`` says."""
        self._forget()
        over = partial(self._is_over, aftermath)
        for step in drive(self.env, self.driver, over=over):
            self._note(step.info, step.terminated)
            if self.log is not None:
                self.log.add(self._label, step.car, self.env.get_wrapper_attr("controls"))

    def _note(self, info: dict[str, Any], terminated: bool) -> None:
        """
        Record the results of a timestep.

        :param info: of a timestep
        :param terminated: whether an episode would be over
        """
        self.time = info["car"].time
        self.distance = info["distance"]
        if info["lap_time"]:
            self.lap_times.append(info["lap_time"])
        if terminated and self.end is None:
            self.end, self.end_time = info["end"], self.time

    def _is_over(self, aftermath: float | None) -> bool:
        if self.backend.over:
            return True
        if aftermath is None or self.end_time is None:
            return False
        return bool(self.time > self.end_time + aftermath)
