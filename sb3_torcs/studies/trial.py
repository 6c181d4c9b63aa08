"""One trial of a study: stock SB3 learns in slices, so that a killed training can continue exactly.

A slice is the training between two evaluations. At its beginning all random generators are seeded
by the trial's seed and the slice's number, and the environments are reset, also in a training that
is never killed. So a slice depends on nothing but the checkpoint before it.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

from sb3_torcs.agents.models import load_driver
from sb3_torcs.agents.saved.driver import ModelDriver
from sb3_torcs.agents.saved.record import BEST_MODEL, STATISTICS, TrainingRecord
from sb3_torcs.agents.saved.writing import recipe, write_record
from sb3_torcs.agents.wrapping import frames_of
from sb3_torcs.callbacks.tree import KeepsArrays, callbacks_in
from sb3_torcs.errors import StudyError
from sb3_torcs.evaluation.ladder import rung
from sb3_torcs.evaluation.protocol import Episode, Merit, evaluate, merit, race_environment
from sb3_torcs.policies.threads import one_thread
from sb3_torcs.studies.config import FIELDS, Trial, track_name
from sb3_torcs.studies.storage import DIVERGED
from sb3_torcs.training.keeping import check_healthy
from sb3_torcs.training.manager import build

__all__ = ["Row", "Training", "final_row"]

Row = dict[str, Any]

LAST_MODEL, REPLAY, STATE = "last_model.zip", "replay.npz", "state.json"
LAST_STATISTICS = "statistics.pkl"
NOTHING_DRIVEN = Episode(0, [], 0.0, DIVERGED, 0.0, 0.0)  # by an agent that was never evaluated


class Training:
    """
    One agent that learns.

    :param trial: what is to be learned, and how
    :param checkpoint: a folder that :meth:`save` has written; ``None`` begins anew
    :raises StudyError: if the checkpoint cannot be read
    """

    def __init__(self, trial: Trial, checkpoint: Path | None = None) -> None:
        self.trial = trial
        self.rows: list[Row] = []
        self.episodes = 0  # that have ended, in all training environments together
        self._best: Merit | None = None
        self._best_files: dict[str, bytes] = {}
        self._spent = np.zeros(2)  # [s] of the clock and of the processor, before this process
        self._races: dict[str, Any] = {}
        self.model, self.callbacks, self._records = build(
            trial.algo, trial.env_id, trial.entry, seed=trial.seed
        )
        if checkpoint is None:
            return
        try:
            self._load(checkpoint)
        except Exception as error:  # a broken file can raise anything
            self.close()
            raise StudyError(
                f"its checkpoint cannot be read ({type(error).__name__}: {error}); remove the "
                f"folder {trial.name} of the study to begin that agent anew"
            ) from error

    @property
    def slices(self) -> int:
        """Number of slices that are complete."""
        return len(self.rows) // len(self.trial.eval_tracks)

    @property
    def normalizer(self) -> VecNormalize | None:
        """Statistics of the observations, if the entry asks for them."""
        found: VecNormalize | None = self.model.get_vec_normalize_env()
        return found

    @one_thread()  # trials run side by side: more threads of torch would slow them down
    def run(self, after_slice: Callable[[], None]) -> None:
        """
        Learn to the end of the budget.

        :param after_slice: called after each evaluation; may call :meth:`save`
        :raises StudyError: if a callback stops the training early
        :raises TrainingDiverged: if the model computes no numbers any more
        """
        remaining = self.trial.budget - self.model.num_timesteps
        self._clock = _clocks()
        slices = _Slices(self, after_slice)
        if remaining > 0:
            env = self.model.get_env()
            # Not None, so that SB3 does not reset the environments: a slice does.
            self.model._last_obs = np.zeros((env.num_envs, *env.observation_space.shape))
            self.model.set_logger(Logger(None, []))  # SB3's own leaves an empty folder behind
            # Slices come last, after other callbacks have undone their changes of a rollout.
            callbacks = [*self.callbacks, slices]
            # One learn() for all slices, so that schedules span the whole budget.
            try:
                self.model.learn(remaining, callback=callbacks, reset_num_timesteps=False)
            except Exception:
                check_healthy(self.model)  # explains what SB3 or the environment complains about
                raise
            if self.model.num_timesteps < self.trial.budget:
                raise StudyError(
                    f"a callback stopped the training at {self.model.num_timesteps} of "
                    f"{self.trial.budget} timesteps; those of a study go to the end of the budget: "
                    "take that callback away"
                )
            slices.end()

    def begin_slice(self) -> None:
        """Seed all generators by the trial's seed and the slice's number; reset the cars."""
        model, env = self.model, self.model.get_env()
        sequence = np.random.SeedSequence((self.trial.seed, self.slices))
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
        self.episodes += int(running.sum())
        _cut_episodes(self.model, running)
        races = {track: self._race(track) for track in self.trial.eval_tracks}
        worth = merit(list(races.values()))
        kept = self._best is None or worth > self._best
        if kept:
            self._best, self._best_files = worth, self._model_files()
        progress = {**self._progress(), "kept": kept}
        for track, race in races.items():
            self.rows.append(_row(self.trial, "train", track, race, progress))

    def rows_of_nothing(self) -> list[Row]:
        """Return the rows of an agent that has diverged before its first evaluation."""
        trial, progress = self.trial, {**self._progress(), "kept": True}
        phases = [("train", track) for track in trial.eval_tracks]
        phases += [("final", track) for track in trial.final_tracks]
        return [_row(trial, phase, track, NOTHING_DRIVEN, progress) for phase, track in phases]

    def save(self, folder: Path) -> None:
        """
        Save everything that the rest of the training depends on, and the best model.

        :param folder: an empty one
        """
        self._save_model(folder / LAST_MODEL)
        if getattr(self.model, "replay_buffer", None) is not None:
            arrays: dict[str, Any] = dict(_buffer_arrays(self.model.replay_buffer))
            np.savez(folder / REPLAY, **arrays)
        for name, callback in self._keepers():
            np.savez(folder / name, **callback.arrays())
        if self.normalizer is not None:
            self.normalizer.save(str(folder / LAST_STATISTICS))
        for name, content in {**self._best_files, **self._records}.items():
            (folder / name).write_bytes(content)
        state = {
            "rows": self.rows,
            "episodes": self.episodes,
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
        for name, callback in self._keepers():
            with np.load(folder / name) as arrays:
                callback.restore(arrays)
        state = json.loads((folder / STATE).read_text(encoding="utf-8"))
        self.rows, self.episodes = state["rows"], state["episodes"]
        self._best, self._spent = Merit(*state["best"]), np.array(state["spent"])
        for car, mishaps in enumerate(state["mishaps"]):
            env.env_method("set_mishaps", mishaps, indices=car)
        names = (BEST_MODEL, STATISTICS)
        self._best_files = {n: (folder / n).read_bytes() for n in names if (folder / n).is_file()}

    def _keepers(self) -> Iterator[tuple[str, KeepsArrays]]:
        """Find the callbacks that keep arrays, and name their files in a checkpoint."""
        every = chain.from_iterable(map(callbacks_in, self.callbacks))
        for number, callback in enumerate(own for own in every if isinstance(own, KeepsArrays)):
            yield f"callback-{number}.npz", callback

    def _progress(self) -> Row:
        """Say how far the training has come."""
        spent = self._spent + _clocks() - self._clock
        return {
            "decisions": self.model.num_timesteps,
            "episodes": self.episodes,
            "wall_s": round(float(spent[0]), 1),
            "cpu_s": round(float(spent[1]), 1),
        }

    def _race(self, track: str) -> Episode:
        if track not in self._races:
            self._races[track] = _race_environment(self.trial, track)
        driver = ModelDriver(self.model, self.normalizer, frames_of(self.trial.entry))
        (episode,) = evaluate(self._races[track], driver)
        return episode

    def _save_model(self, file: Path | io.BytesIO) -> None:
        trial = self.trial
        write_record(self.model, recipe(trial.algo, trial.env_id, trial.entry))
        # A class of replay buffer that SB3 chose would be taken for the user's when it is loaded.
        chosen = "replay_buffer_class" not in self.trial.entry
        self.model.save(file, exclude=["replay_buffer_class"] if chosen else None)

    def _model_files(self) -> dict[str, bytes]:
        """Return the present model as files that ``sb3-torcs evaluate`` reads."""
        buffer = io.BytesIO()
        self._save_model(buffer)
        files = {BEST_MODEL: buffer.getvalue()}
        if self.normalizer is not None:
            with tempfile.NamedTemporaryFile() as file:
                self.normalizer.save(file.name)
                files[STATISTICS] = Path(file.name).read_bytes()
        return files


class _Slices(BaseCallback):
    """Divides one ``learn`` into slices, between two rollouts."""

    def __init__(self, training: Training, after_slice: Callable[[], None]) -> None:
        super().__init__()
        self.training = training
        self.after_slice = after_slice
        self._running = np.zeros(0, dtype=bool)
        self._number: int | None = None  # of the slice: intervals that lie before it

    def _on_rollout_start(self) -> None:
        number = self.model.num_timesteps // self.training.trial.eval_interval
        if number == self._number:
            return
        if self._number is not None:
            self.end()
        self._number = number
        self.training.begin_slice()

    def _on_step(self) -> bool:
        dones = self.locals["dones"]
        self.training.episodes += int(dones.sum())
        self._running = ~dones.astype(bool)
        return True

    def end(self) -> None:
        """End a slice."""
        self.training.end_slice(self._running)
        self.after_slice()


@one_thread()
def final_row(trial: Trial, model: Path, track: str, progress: Row) -> Row:
    """
    Measure a trial's best model on one track, in a fresh evaluation.

    :param trial: whose model it is
    :param model: the file, its records beside it; there is none of an agent that has diverged
        before its first evaluation
    :param track: to drive on
    :param progress: the row of the evaluation that the model was kept for
    :return: a row of the results
    """
    race = NOTHING_DRIVEN
    if progress["end"] != DIVERGED:
        with contextlib.closing(_race_environment(trial, track)) as env:
            (race,) = evaluate(env, load_driver(model, env, trial.algo))
    kept_at = {name: progress[name] for name in ("decisions", "episodes", "wall_s", "cpu_s")}
    return _row(trial, "final", track, race, {**kept_at, "kept": True})


def _with_statistics(env: Any, file: Path) -> Any:
    """Replace new statistics by saved ones; they may be below VecFrameStack."""
    if isinstance(env, VecNormalize):
        return VecNormalize.load(str(file), env.venv)
    env.venv = _with_statistics(env.venv, file)
    return env


def _race_environment(trial: Trial, track: str) -> Any:
    """Build the environment of an evaluation; a study's wrappers are those of who started it."""
    env_kwargs = {**trial.env_kwargs, "car": _car(trial)}
    return race_environment(
        trial.env_id, env_kwargs, track, hyperparameters=trial.entry, trust=True
    )


def _car(trial: Trial) -> str:
    """Choose the car that evaluations drive."""
    return TrainingRecord(env_kwargs=trial.env_kwargs).one_car


def _row(trial: Trial, phase: str, track: str, race: Episode, more: Row) -> Row:
    """Make the row of one race."""
    name = track_name(track)
    row = {
        "study": trial.study,
        "variant": trial.variant,
        "seed": trial.seed,
        "phase": phase,
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
        "ladder": rung(race, trial.env_id, _car(trial), name),
        **more,
    }
    return {field: row[field] for field in FIELDS}


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
