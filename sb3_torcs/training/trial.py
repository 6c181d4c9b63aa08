"""The loop in which an agent learns: build, learn, evaluate, save.

A slice is the training between two evaluations. A training is *exact* if it can be killed at any
evaluation and continued to the same result. For that, each slice begins with generators that are
seeded by the training's seed and the slice's number, and with new episodes, also in a training that
is never killed. So a slice depends on nothing but the checkpoint before it. Trainings of a study
are exact. Others are those of the RL Zoo: evaluations leave them as they are.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

from sb3_torcs.agents.saved.driver import ModelDriver
from sb3_torcs.agents.saved.record import BEST_MODEL, TrainingRecord
from sb3_torcs.agents.saved.writing import RecordCallback, recipe
from sb3_torcs.agents.wrapping import frames_of
from sb3_torcs.callbacks.driven_line import LineRecorder
from sb3_torcs.callbacks.metrics import LineListener
from sb3_torcs.callbacks.tree import callbacks_in
from sb3_torcs.errors import StudyError
from sb3_torcs.evaluation.ladder import rung
from sb3_torcs.evaluation.protocol import Episode, Merit, evaluate, merit, race_environment
from sb3_torcs.policies.threads import one_thread
from sb3_torcs.torcs.track_names import RANDOM_TRACK
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.training.build import build
from sb3_torcs.training.keeping import check_healthy

__all__ = ["Recipe", "Row", "Training", "track_name"]

Row = dict[str, Any]

LAST_MODEL, REPLAY, STATE = "last_model.zip", "replay.npz", "state.json"
LAST_STATISTICS = "statistics.pkl"


@dataclass(frozen=True)
class Recipe:
    """Everything that a training depends on."""

    algo: str  # as the zoo calls it
    env_id: str
    entry: dict[str, Any]  # of a hyperparameter file, changes applied
    seed: int
    eval_interval: int  # timesteps
    eval_tracks: tuple[str, ...]  # that choose the model; without any there are no evaluations

    @property
    def budget(self) -> int:
        """Timesteps to learn from."""
        return int(float(self.entry["n_timesteps"]))

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of the training's environment."""
        return dict(self.entry.get("env_kwargs") or {})

    @property
    def car(self) -> str:
        """The car that evaluations drive."""
        return TrainingRecord(env_kwargs=self.env_kwargs).one_car

    def race_environment(self, track: str) -> Any:
        """
        Build the environment of an evaluation.

        Its wrappers are trusted: they are those of the person who trains.

        :param track: to drive on
        """
        return race_environment(
            self.env_id,
            {**self.env_kwargs, "car": self.car},
            track,
            hyperparameters=self.entry,
            trust=True,
        )

    def row(self, track: str, race: Episode) -> Row:
        """
        Return the columns of a table of results that describe a race.

        :param track: on which it was driven
        :param race: that was driven
        """
        name = track_name(track)
        return {
            "track": name,
            "laps": race.laps,
            "completes": race.finished,
            "lap_times_s": [round(seconds, 3) for seconds in race.lap_times],
            "best_flying_lap_s": race.flying_lap and round(race.flying_lap, 3),
            "race_time_s": round(race.race_time, 3) if race.finished else None,
            "distance_m": round(race.distance, 3),
            "end": race.end,
            "damage": race.damage,
            "return": race.episode_return,
            "ladder": rung(race, self.env_id, self.car, name),
        }


class Training:
    """
    One agent that learns.

    :param recipe: what is to be learned, and how
    :param checkpoint: a folder that :meth:`save` has written; ``None`` begins a training
    :param exact: whether the training can be continued exactly
    :param episodes: per track and evaluation
    :param places: folders and files for :func:`~sb3_torcs.training.build.build`
    :raises StudyError: if the checkpoint cannot be read
    """

    def __init__(
        self,
        recipe: Recipe,
        checkpoint: Path | None = None,
        *,
        exact: bool = True,
        episodes: int = 1,
        **places: Path | None,
    ) -> None:
        self.recipe = recipe
        self.exact = exact
        self.rows: list[Row] = []
        self.best_model: bytes | None = None  # as SB3 saves it
        self.learned_from = 0  # timesteps; a rollout counts when the model has learned from it
        self._evaluated_episodes = episodes
        self._slices = 0  # that are complete
        self._ended = 0  # episodes of all training environments together
        self._best: Merit | None = None
        self._spent = np.zeros(2)  # [s] of the clock and of the processor, before this process
        self._races: dict[str, LineRecorder] = {}
        self.model, self.callbacks = build(
            recipe.algo, recipe.env_id, recipe.entry, seed=recipe.seed, **places
        )
        if checkpoint is None:
            return
        try:
            self._load(checkpoint)
        except Exception as error:  # a broken file can raise anything
            self.close()
            raise StudyError(
                f"its checkpoint cannot be read ({type(error).__name__}: {error}); remove its "
                "folder to start this agent again"
            ) from error

    @property
    def normalizer(self) -> VecNormalize | None:
        """Statistics of the observations, if the entry asks for them."""
        found: VecNormalize | None = self.model.get_vec_normalize_env()
        return found

    @one_thread()  # more threads of torch would slow small networks down
    def run(self, after_slice: Callable[[], None], interrupts: Sequence[int] = ()) -> None:
        """
        Learn to the end of the budget.

        :param after_slice: called after each evaluation; may save
        :param interrupts: signals so far: with one of them the training ends, also if Python has
            ignored the ``KeyboardInterrupt`` that it raised, as it does in code that C calls
        :raises StudyError: if a callback stops an exact training early
        :raises TrainingDiverged: if the model computes no numbers any more
        """
        self._clock = _clocks()
        remaining = self.recipe.budget - (self.model.num_timesteps if self.exact else 0)
        if remaining <= 0:
            return
        slices = _Slices(self, after_slice, interrupts)
        how = self.recipe.algo, self.recipe.env_id, self.recipe.entry
        # The record comes first, before others save the model. Slices come last, after other
        # callbacks have undone their changes of a rollout.
        callbacks = [RecordCallback(recipe(*how)), *self.callbacks, slices]
        if self.exact:
            env = self.model.get_env()
            # Not None, so that SB3 does not reset the environments: a slice does.
            self.model._last_obs = np.zeros((env.num_envs, *env.observation_space.shape))
            self.model.set_logger(Logger(None, []))  # SB3's own leaves an empty folder behind
        # One learn() for all slices, so that schedules span the whole budget.
        try:
            self.model.learn(remaining, callback=callbacks, reset_num_timesteps=not self.exact)
        except Exception:
            check_healthy(self.model)  # explains what SB3 or the environment complains about
            raise
        if self.exact and self.model.num_timesteps < self.recipe.budget:
            raise StudyError(
                f"a callback stopped the training at {self.model.num_timesteps} of "
                f"{self.recipe.budget} timesteps; those of a study go to the end of the budget: "
                "take that callback away"
            )
        slices.end()

    def begin_slice(self) -> None:
        """Seed all generators by the training's seed and the slice's number; reset the cars."""
        if not self.exact:
            return
        model, env = self.model, self.model.get_env()
        sequence = np.random.SeedSequence((self.recipe.seed, self._slices))
        model.set_random_seed(int(sequence.generate_state(1)[0]))
        model._last_obs = env.reset()
        model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        if self.normalizer is not None:
            model._last_original_obs = self.normalizer.get_original_obs()
        if getattr(model, "action_noise", None) is not None:
            model.action_noise.reset()
        if model.use_sde:  # SB3 drew it before this callback
            getattr(model.policy, "actor", model.policy).reset_noise(env.num_envs)

    def end_slice(self, running: np.ndarray) -> None:
        """
        Evaluate, and keep the model if it is the best so far.

        :param running: (n_envs,) whether an episode is cut here
        """
        check_healthy(self.model)
        self._slices += 1
        if self.exact:
            self._ended += int(running.sum())
            _cut_episodes(self.model, running)
        if not self.recipe.eval_tracks:
            return
        races = [(track, race) for track in self.recipe.eval_tracks for race in self._drive(track)]
        worth = merit([race for _, race in races])
        kept = self._best is None or worth > self._best
        if kept:
            self._best, self.best_model = worth, self.model_file()
        progress = {**self.progress(), "kept": kept}
        self.rows += [{**self.recipe.row(track, race), **progress} for track, race in races]
        self._show([race for _, race in races])

    def progress(self) -> Row:
        """Return how far the training is: the columns of a row that are not of a race."""
        spent = self._spent + _clocks() - self._clock
        return {
            "decisions": self.model.num_timesteps,
            "episodes": self._ended,
            "wall_s": round(float(spent[0]), 1),
            "cpu_s": round(float(spent[1]), 1),
        }

    def count_episodes(self, dones: np.ndarray) -> None:
        """
        Count training episodes.

        :param dones: (n_envs,) whether one has ended
        """
        self._ended += int(dones.sum())

    def model_file(self) -> bytes:
        """Return the present model as SB3 saves it, with its record."""
        buffer = io.BytesIO()
        # A class of replay buffer that SB3 chose would be taken for the user's when it is loaded.
        chosen = "replay_buffer_class" not in self.recipe.entry
        self.model.save(buffer, exclude=["replay_buffer_class"] if chosen else None)
        return buffer.getvalue()

    def save(self, folder: Path) -> None:
        """
        Save everything that the rest of the training depends on, and the best model.

        :param folder: an empty one
        """
        (folder / LAST_MODEL).write_bytes(self.model_file())
        if getattr(self.model, "replay_buffer", None) is not None:
            arrays: dict[str, Any] = dict(_buffer_arrays(self.model.replay_buffer))
            np.savez(folder / REPLAY, **arrays)
        if self.normalizer is not None:
            self.normalizer.save(str(folder / LAST_STATISTICS))
        if self.best_model is not None:
            (folder / BEST_MODEL).write_bytes(self.best_model)
        state = {
            "rows": self.rows,
            "slices": self._slices,
            "episodes": self._ended,
            "best": self._best,
            "spent": list(self._spent + _clocks() - self._clock),
            "mishaps": self.model.get_env().env_method("mishaps"),
        }
        (folder / STATE).write_text(json.dumps(state), encoding="utf-8")

    def close(self) -> None:
        """Close the environments."""
        self.model.get_env().close()
        for env in self._races.values():
            env.close()

    def _load(self, folder: Path) -> None:
        env = self.model.get_env()
        if (folder / LAST_STATISTICS).is_file():
            env = _with_statistics(env, folder / LAST_STATISTICS)
        self.model = type(self.model).load(folder / LAST_MODEL, env=env, device="cpu")
        if (folder / REPLAY).is_file():
            with np.load(folder / REPLAY) as arrays:
                _refill(self.model.replay_buffer, arrays)
        state = json.loads((folder / STATE).read_text(encoding="utf-8"))
        self.rows, self._slices, self._ended = state["rows"], state["slices"], state["episodes"]
        self._best, self._spent = Merit(*state["best"]), np.array(state["spent"])
        for car, mishaps in enumerate(state["mishaps"]):
            env.env_method("set_mishaps", mishaps, indices=car)
        self.best_model = (folder / BEST_MODEL).read_bytes()

    def _drive(self, track: str) -> list[Episode]:
        if track not in self._races:
            self._races[track] = LineRecorder(self.recipe.race_environment(track))
        driver = ModelDriver(self.model, self.normalizer, frames_of(self.recipe.entry))
        return evaluate(self._races[track], driver, episodes=self._evaluated_episodes)

    def _show(self, races: Sequence[Episode]) -> None:
        """Log an evaluation, and hand its line on the first track to those who show lines."""
        logger = self.model.logger
        logger.record("eval/mean_reward", float(np.mean([race.episode_return for race in races])))
        line = self._races[self.recipe.eval_tracks[0]].line()
        for callback in chain.from_iterable(map(callbacks_in, self.callbacks)):
            if isinstance(callback, LineListener):
                callback.take_line(line)
        logger.dump(self.model.num_timesteps)


class _Slices(BaseCallback):
    """Divides one ``learn`` into slices, between two rollouts."""

    def __init__(
        self, training: Training, after_slice: Callable[[], None], interrupts: Sequence[int]
    ) -> None:
        super().__init__()
        self.training = training
        self.after_slice = after_slice
        self._interrupts = interrupts
        self._running = np.zeros(0, dtype=bool)
        self._number: int | None = None  # of the slice: intervals that lie before it

    def _on_rollout_start(self) -> None:
        self.training.learned_from = self.model.num_timesteps
        number = self.model.num_timesteps // self.training.recipe.eval_interval
        if number == self._number:
            return
        if self._number is not None:
            self.end()
        self._number = number
        self.training.begin_slice()

    def _on_step(self) -> bool:
        if self._interrupts:
            raise KeyboardInterrupt
        dones = self.locals["dones"]
        self.training.count_episodes(dones)
        self._running = ~dones.astype(bool)
        return True

    def end(self) -> None:
        """End a slice."""
        self.training.learned_from = self.model.num_timesteps
        self.training.end_slice(self._running)
        self.after_slice()


def track_name(track: str) -> str:
    """
    Return the name of a track in results.

    :param track: name or path
    :return: the name without category
    """
    return track if track == RANDOM_TRACK else load_track(track).name


def _with_statistics(env: Any, file: Path) -> Any:
    """Replace new statistics by saved ones; they may be below VecFrameStack."""
    if isinstance(env, VecNormalize):
        return VecNormalize.load(str(file), env.venv)
    env.venv = _with_statistics(env.venv, file)
    return env


def _clocks() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


def _cut_episodes(model: Any, running: np.ndarray) -> None:
    """
    Mark the ends of these episodes in the replay buffer, as those by a time limit.

    Otherwise returns over several timesteps would reach into the next episode.
    """
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None and buffer.handle_timeout_termination:
        buffer.dones[buffer.pos - 1, running] = True
        buffer.timeouts[buffer.pos - 1, running] = True


def _rings(buffer: Any) -> dict[str, np.ndarray]:
    """Return the arrays of a replay buffer that have one row per timestep."""
    return {
        name: value
        for name, value in vars(buffer).items()
        if isinstance(value, np.ndarray) and value.shape[:1] == (buffer.buffer_size,)
    }


def _buffer_arrays(buffer: Any) -> dict[str, np.ndarray]:
    """Return the arrays of a replay buffer, without the rows that were never filled."""
    rows = buffer.size()
    rings = {name: ring[:rows] for name, ring in _rings(buffer).items()}
    return {**rings, "pos": np.array(buffer.pos), "full": np.array(buffer.full)}


def _refill(buffer: Any, arrays: Any) -> None:
    """Fill a new replay buffer with saved arrays."""
    for name, ring in _rings(buffer).items():
        ring[: len(arrays[name])] = arrays[name]
    buffer.pos, buffer.full = int(arrays["pos"]), bool(arrays["full"])
