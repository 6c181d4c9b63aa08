"""Study files, read and checked before anything starts.

A study is a table of variants by seeds. A variant is an entry of a hyperparameter file of the RL
Zoo with some of its values changed; a trial is one variant with one seed.

The checks are written by hand: as a schema of pydantic they are longer, since each mistake needs
its own words for what to type instead, and most lie in the RL Zoo's entry, which no schema knows.
"""

from __future__ import annotations

import contextlib
import copy
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import yaml

from sb3_torcs.agents.saved.algorithm import SBX
from sb3_torcs.errors import (
    BackendUnavailable,
    Sb3TorcsError,
    StudyError,
    ZooConfigError,
    near_miss,
)
from sb3_torcs.evaluation.protocol import GAME
from sb3_torcs.files import as_list, read_yaml
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.torcs.track_names import find_track
from sb3_torcs.tracks.catalogue import CATEGORIES, tracks_of
from sb3_torcs.training import zoo
from sb3_torcs.training.trial import Recipe, track_name
from sb3_torcs.training.zoo_data import as_data

__all__ = ["FIELDS", "Study", "Trial", "merged", "read_study", "slug", "trial_name"]

REQUIRED = ("name", "seeds", "eval_interval")
SOURCE = (
    "algo", "env", "conf_file", "entry", "n_timesteps", "eval_interval", "eval_tracks",
)  # fmt: skip
"""What a study says for all its variants, and a variant may say for itself."""

WORDS = ("algo", "env", "conf_file", "entry")
KEYS = tuple(dict.fromkeys((*REQUIRED, *SOURCE, "variants", "final_tracks")))
SEEDS = 2**32  # that NumPy takes
MANY = 10_000  # a larger number of seeds is one seed, without its brackets

FIELDS = (
    "study", "variant", "seed", "phase", "decisions", "episodes", "wall_s", "cpu_s", "track",
    "laps", "completes", "lap_times_s", "best_flying_lap_s", "race_time_s", "distance_m", "end",
    "damage", "return", "kept", "ladder",
)  # fmt: skip
"""Columns of the results; ``docs/studies.md`` says what they mean."""


@dataclass(frozen=True)
class Trial(Recipe):
    """One variant with one seed."""

    study: str
    variant: str
    final_tracks: tuple[str, ...]  # that the chosen model is measured on

    @property
    def name(self) -> str:
        """What its folder is called."""
        return trial_name(self.variant, self.seed)

    def recipe(self) -> dict[str, Any]:
        """Return everything that the training depends on."""
        recipe = {**asdict(self), "eval_tracks": list(self.eval_tracks)}
        del recipe["final_tracks"]
        return recipe


@dataclass(frozen=True)
class Study:
    """The content of a study file."""

    name: str
    path: Path
    trials: tuple[Trial, ...]


def read_study(path: str | Path) -> Study:
    """
    Read a study file, and check all that can be checked without training.

    :param path: of a YAML file; ``docs/studies.md`` says what it holds
    :return: the study
    :raises StudyError: if the file has a mistake
    :raises ZooConfigError: if the hyperparameters of a variant have a mistake
    """
    file = Path(os.path.expanduser(path))
    said = _read(file)
    _check_keys(said, KEYS, f"{file}: unknown key")
    for key in REQUIRED:
        if key not in said:
            raise StudyError(f"{file}: key '{key}' is missing; required: {', '.join(REQUIRED)}")
    name = said["name"]
    if not isinstance(name, str) or not slug(name):
        raise StudyError(f"{file}: name is {name!r}; expected a word, e.g. aalborg")
    variants = said.get("variants") or {"default": {}}
    if not isinstance(variants, dict):
        raise StudyError(f"{file}: variants is {variants!r}; expected 'NAME: {{key: value}}'")
    seeds = _seeds(said["seeds"], file)
    trials = tuple(
        trial
        for variant, changes in variants.items()
        for trial in _trials(file, said, str(variant), changes or {}, seeds)
    )
    names = [trial.name for trial in trials]
    if len(set(names)) < len(names):
        raise StudyError(f"{file}: two variants have names that differ in signs only; rename one")
    return Study(slug(name), file, trials)


def merged(entry: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """
    Change an entry: mappings are merged, ``null`` removes, other values replace.

    The list of callbacks is changed by a mapping from dotted paths to arguments: new paths are
    added to the list.

    :param entry: of a hyperparameter file
    :param changes: to it
    :return: the new entry
    """
    result = copy.deepcopy(dict(entry))
    for key, value in changes.items():
        if value is None:
            if key not in result:
                raise StudyError(f"null takes '{key}' away, but it is not there; leave it out")
            del result[key]
        elif key == "callback" and isinstance(value, Mapping):
            result[key] = _merged_callbacks(result.get(key), value)
        elif isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = merged(result[key], value)
        else:
            result[key] = copy.deepcopy(value)
    return result


def trial_name(variant: str, seed: int) -> str:
    """
    Return what the folder of a trial is called.

    :param variant: of the study
    :param seed: of the trial
    """
    return f"{slug(variant)}-seed{seed}"


def slug(text: str) -> str:
    """
    Make a name that can be a folder's.

    :param text: any
    :return: letters, digits, dots and hyphens
    """
    return re.sub(r"[^\w.]+", "-", text).strip("-.").lower()


class _Once(yaml.SafeLoader):
    """Refuses a key that is there twice; YAML's own loader takes the last of two variants."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        mapping: yaml.MappingNode = super().compose_mapping_node(anchor)
        seen = set()
        for key in (key for key, _ in mapping.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                problem = f"key '{key.value}' is there twice; rename one"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            seen.add(key.value)
        return mapping


def _read(file: Path) -> dict[str, Any]:
    try:
        if not file.is_file():
            raise StudyError(f"there is no study file '{file}'; give a .yml file")
        said = read_yaml(file.read_text(encoding="utf-8"), _Once)
    except OSError as error:
        raise StudyError(f"{file} cannot be read: {error.strerror or error}") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f", line {mark.line + 1}" if mark else ""
        raise StudyError(f"{file}{line}: not YAML: {error.problem or error.context}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        why = " ".join(str(error).split())
        raise StudyError(f"{file}: not YAML: {why}") from error
    if not isinstance(said, dict):
        raise StudyError(f"{file}: expected 'key: value' lines, got {said!r:.80}")
    return said


def _seeds(value: Any, file: Path) -> list[int]:
    """Read ``5``, which is 0 to 4, or a list."""
    if type(value) is int and value > MANY:
        raise StudyError(f"{file}: seeds is {value}, too many; one seed is a list: [{value}]")
    seeds = list(range(value)) if type(value) is int else value
    if (
        not isinstance(seeds, list)
        or not seeds
        or not all(type(seed) is int and 0 <= seed < SEEDS for seed in seeds)
        or len(set(seeds)) < len(seeds)
    ):
        raise StudyError(
            f"{file}: seeds is {value!r}; expected how many (at least 1), or a list of different "
            "whole numbers from 0 to 2**32 - 1, e.g. [0, 1, 2]"
        )
    return seeds


def _trials(
    file: Path, said: Mapping[str, Any], variant: str, changes: Any, seeds: Sequence[int]
) -> Iterable[Trial]:
    """Read one variant."""
    place = zoo.Place(file, f"variants: {variant}")
    if not isinstance(changes, dict) or not slug(variant):
        raise StudyError(f"{place}: expected 'NAME: {{key: value}}', got {changes!r}")
    source = _source(said, changes, place)
    algo, env_id = source["algo"] or "ddpg", source["env"] or "Torcs-v0"
    zoo.check_racing(env_id)
    if algo.startswith(SBX):
        raise StudyError(
            f"{place}: algo is {algo}, and a study cannot stop and continue trainings of SBX "
            f"exactly; give {algo.removeprefix(SBX)}, or type: sb3-torcs train --algo {algo}"
        )
    conf_file = source["conf_file"] and file.parent / Path(os.path.expanduser(source["conf_file"]))
    entries = zoo.config_file(algo, conf_file, "conf_file: FILE.yml")
    entry = zoo.read_entry(entries, source["entry"] or env_id)
    if source["n_timesteps"] is not None:
        entry["n_timesteps"] = source["n_timesteps"]
    try:
        entry = merged(entry, {key: value for key, value in changes.items() if key not in SOURCE})
    except StudyError as error:
        raise StudyError(f"{place}: {error}") from None
    entry = as_data(entry)
    zoo.check_entry(entry, algo, env_id, place)
    entry["n_timesteps"] = zoo.timesteps(entry)
    interval = source["eval_interval"]
    if type(interval) is not int or interval < 1:
        raise StudyError(f"{place}: eval_interval is {interval!r}; expected timesteps, e.g. 5000")
    env_kwargs = entry.get("env_kwargs") or {}
    own = env_kwargs.get("track", "aalborg")
    given = source["eval_tracks"]
    with _told_at(place):
        zoo.checked_env(entry, env_id, place).close()
    eval_tracks = _tracks(own if given is None else given, env_id, f"{place}: eval_tracks")
    final_tracks = eval_tracks
    if said.get("final_tracks") is not None:
        chosen = _tracks(said["final_tracks"], env_id, f"{file}: final_tracks")
        final_tracks = _united(eval_tracks, chosen)
    for seed in seeds:
        yield Trial(
            algo, env_id, copy.deepcopy(entry), seed, interval, eval_tracks,
            slug(said["name"]), variant, final_tracks,
        )  # fmt: skip


def _source(
    said: Mapping[str, Any], changes: Mapping[str, Any], place: zoo.Place
) -> dict[str, Any]:
    """Collect the options of a variant, or else those of the study."""
    source = {key: changes.get(key, said.get(key)) for key in SOURCE}
    for key in WORDS:
        if not isinstance(source[key], str | None):
            raise StudyError(f"{place}: {key} is {source[key]!r}; expected a word")
    return source


@contextlib.contextmanager
def _told_at(place: zoo.Place | str) -> Iterator[None]:
    """Let an error tell where the file says what is wrong."""
    try:
        yield
    except (BackendUnavailable, ZooConfigError):  # not the file's, or it tells the place itself
        raise
    except Sb3TorcsError as error:
        raise StudyError(f"{place}: {error}") from error


def _tracks(value: Any, env_id: str, what: str) -> tuple[str, ...]:
    """Read a list of tracks of a world; a category stands for all of its tracks."""
    tracks = [value] if isinstance(value, str) else value
    named = isinstance(tracks, list) and all(isinstance(track, str) for track in tracks)
    if not named or not tracks:
        categories = ", ".join(f"'{category}'" for category in CATEGORIES)
        raise StudyError(f"{what} is {value!r}; expected a list of tracks, or of {categories}")
    with _told_at(what):
        tracks = list(chain.from_iterable(map(tracks_of, tracks)))
        if env_id == GAME:
            game = find_game()
            for track in tracks:
                find_track(track, game)
        names = [track_name(track) for track in tracks]
    if len(set(names)) < len(names):
        raise StudyError(f"{what}: {', '.join(names)}: one is there twice; take it out")
    return tuple(tracks)


def _united(one: Sequence[str], other: Sequence[str]) -> tuple[str, ...]:
    """Put two lists of tracks together; a track may have another name in each."""
    named = {track_name(track): track for track in (*one, *other)}
    return tuple(named.values())


def _check_keys(mapping: Mapping[str, Any], known: Sequence[str], what: str) -> None:
    for key in mapping:
        if key not in known:
            hint = near_miss(key, known, f"allowed: {', '.join(known)}")
            raise StudyError(f"{what} '{key}'{hint}")


def _merged_callbacks(callbacks: Any, changes: Mapping[str, Any]) -> list[Any]:
    """
    Change a list of callbacks item by item, since a callback may be there twice.

    :param callbacks: of an entry, in any of the zoo's forms
    :param changes: arguments by dotted path
    :return: the new list
    :raises StudyError: if a change is of one that is there twice
    """
    pairs = [pair for item in as_list(callbacks) for pair in _paths_and_arguments(item)]
    for path, change in _paths_and_arguments(changes):
        found = [index for index, (known, _) in enumerate(pairs) if known == path]
        if len(found) > 1:
            raise StudyError(
                f"callback changes '{path}', which the entry has {len(found)} times; give the "
                "whole list instead: 'callback: [...]'"
            )
        at = found[0] if found else len(pairs)
        changed = merged(dict(pairs[at : at + 1]), {path: change})
        pairs[at : at + 1] = changed.items()
    return [{path: arguments} if arguments else path for path, arguments in pairs]


def _paths_and_arguments(item: Any) -> list[tuple[Any, Any]]:
    """Read an item of a list of callbacks; a wrong one is refused with the whole entry."""
    return list(item.items()) if isinstance(item, Mapping) else [(item, {})]
