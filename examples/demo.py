"""Train DDPG on TorcsLite-v0 and show what it learned: `make demo` runs this.

Ctrl-C at any time keeps what was learned; a second run goes on, or starts over as asked.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_torcs.agents.models import find_model, load_driver, saved_timesteps
from sb3_torcs.cli.common import positive, seed
from sb3_torcs.errors import OutputNotWritable, Sb3TorcsError
from sb3_torcs.evaluation.protocol import Timestep, drive
from sb3_torcs.files import writable_folder
from sb3_torcs.training import zoo
from sb3_torcs.training.run import TrainOptions, train_run

ALGO, ENV, TRACK = "ddpg", "TorcsLite-v0", "aalborg"
LAPS = 3  # the best of these is shown
EVALUATIONS = 40  # of a whole training

STATE, LOG, RUNS = "demo.json", "training.log", "runs"
MODEL, LAST_MODEL, TENSORBOARD = "model.zip", "last_model.zip", "tensorboard"
VIDEO, PICTURE = "lap.mp4", "line.png"
EVERYTHING = (STATE, LOG, RUNS, MODEL, LAST_MODEL, TENSORBOARD, VIDEO, PICTURE)


def main(words: list[str] | None = None) -> int:
    args = parse(words)
    folder = args.folder
    wanted, done = read_state(folder)
    plan = choose(args, wanted, done)
    if plan == "fresh":
        clear(folder)
        wanted, done = None, 0
    if plan != "show":
        wanted = args.timesteps or wanted or shipped_timesteps()
    interrupted = False
    if wanted is not None and plan != "show" and done < wanted:
        interrupted = train(folder, wanted, done, args.seed)
    failed = show(folder, interrupted)
    print(last_words(folder))
    return 130 if interrupted else int(failed)


def parse(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--continue", dest="go_on", action="store_true", help="go on with what is there"
    )
    how.add_argument("--fresh", action="store_true", help="throw away what is there; start over")
    parser.add_argument(
        "--timesteps", type=positive, metavar="N", help="timesteps to learn from, all runs together"
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="default: 0")
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="default: demo")
    return parser.parse_args(words)


def choose(args: argparse.Namespace, wanted: int | None, done: int) -> str:
    """Decide between "fresh", "continue" and "show"."""
    if wanted is None or args.fresh:
        return "fresh"
    if args.go_on or (args.timesteps or 0) > wanted:
        return "continue"
    finished = done >= wanted
    state = "a finished training" if finished else f"a training, {done:,} of {wanted:,} timesteps"
    print(f"{args.folder}/ holds {state}.")
    keep = "show" if finished else "continue"
    if not sys.stdin.isatty():
        print(f"{keep}: to start over, {again(args.folder, '--fresh')}")
        return keep
    answer = input(f"[Enter] {keep}, or f and [Enter] for a fresh start: ")
    return "fresh" if answer.strip().lower().startswith("f") else keep


def read_state(folder: Path) -> tuple[int | None, int]:
    """Return the timesteps wanted, if a training was ever begun here, and those learned from."""
    if not (folder / STATE).is_file():
        return None, 0
    try:
        wanted = int(json.loads((folder / STATE).read_text())["timesteps"])
    except (ValueError, KeyError, TypeError):  # a full disk took half of it
        wanted = shipped_timesteps()
    return wanted, sum(saved_timesteps(find_model(run, prefer_last=True)) for run in runs(folder))


def runs(folder: Path) -> list[Path]:
    """List the zoo's folders that hold a model, oldest first."""
    found = (folder / RUNS / ALGO).glob(f"{ENV}_*")
    usable = [run for run in found if (run / f"{ENV}.zip").is_file() or best_of(run).is_file()]
    return sorted(usable, key=lambda run: int(run.name.rpartition("_")[2]))


def best_of(run: Path) -> Path:
    return run / "best_model.zip"


def clear(folder: Path) -> None:
    """Remove what an earlier demo made, and nothing else."""
    found = [folder / name for name in EVERYTHING if (folder / name).exists()]
    if found and not (folder / STATE).is_file():
        raise OutputNotWritable(
            f"{found[0]} is not of an earlier demo; move it away, or use another --folder"
        )
    for path in found:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    writable_folder(folder)


def shipped_timesteps() -> int:
    """Return the timesteps that the shipped hyperparameters ask for."""
    return int(zoo.read_entry(zoo.config_file(ALGO), ENV)["n_timesteps"])


def train(folder: Path, wanted: int, done: int, seed: int) -> bool:
    """Learn from the timesteps that are still wanted; say whether Ctrl-C ended it."""
    before = runs(folder)
    (folder / STATE).write_text(json.dumps({"timesteps": wanted, "seed": seed}))
    options = TrainOptions(
        algo=ALGO,
        env=ENV,
        track=TRACK,
        timesteps=wanted - done,
        seed=seed + len(before),  # the same chance twice would teach the same twice
        folder=folder / RUNS,
        tensorboard=folder / TENSORBOARD,
        eval_freq=max(wanted // EVALUATIONS, 1),
        resume=find_model(before[-1], prefer_last=True) if before else None,
    )
    verb = "goes on learning" if before else "learns"
    print(f"DDPG {verb} to drive {TRACK}: {wanted - done:,} timesteps, log in {folder / LOG}.")
    print("Ctrl-C keeps what was learned so far.", flush=True)
    try:
        # The zoo's tables would run through the progress bar.
        with (folder / LOG).open("a", buffering=1) as log, contextlib.redirect_stdout(log):
            interrupted = train_run(options).interrupted
    except KeyboardInterrupt:  # before the first timestep, or a third time
        interrupted = True
    forget(folder)
    return interrupted


def forget(folder: Path) -> None:
    """Drop all replay buffers but the newest: they are large, and only that one is of use."""
    buffers = [run / "replay_buffer.pkl" for run in runs(folder)]
    if buffers and buffers[-1].is_file():
        for buffer in buffers[:-1]:
            buffer.unlink(missing_ok=True)


def best_model(folder: Path) -> Path:
    """Return the model that drove best in any evaluation, or the last one."""

    def score(run: Path) -> float:
        return float(np.load(run / "evaluations.npz")["results"].mean(axis=1).max())

    evaluated = [run for run in runs(folder) if best_of(run).is_file()]
    if evaluated:
        return best_of(max(evaluated, key=score))
    return find_model(runs(folder)[-1], prefer_last=True)


def show(folder: Path, interrupted: bool) -> bool:
    """Make everything there is to look at; say whether anything went wrong."""
    if not runs(folder):
        return False
    if interrupted:
        print("\nStopped. Showing what was learned so far; Ctrl-C skips a step.", flush=True)
    steps: dict[str, Callable[[Path], str]] = {
        "the models": keep_models,
        "the picture": draw,
        "the video": video,
    }
    return not all([attempt(name, step, folder) for name, step in steps.items()])


def attempt(name: str, step: Callable[[Path], str], folder: Path) -> bool:
    """Do one part of the show; if it breaks, it must not take the others along."""
    try:
        print(step(folder), flush=True)
    except KeyboardInterrupt:
        print(f"{name}: skipped")
    except Exception as error:
        print(f"{name}: failed: {type(error).__name__}: {error}")
        return False
    return True


def keep_models(folder: Path) -> str:
    best, last = best_model(folder), find_model(runs(folder)[-1], prefer_last=True)
    shutil.copy(best, folder / MODEL)
    shutil.copy(last, folder / LAST_MODEL)
    return f"{folder / MODEL}: the best model by evaluation"


@contextlib.contextmanager
def car_and_driver(folder: Path, **options: Any) -> Iterator[tuple[Any, Any]]:
    env = gym.make(ENV, track=TRACK, laps=LAPS, **options)
    try:
        yield env, load_driver(best_model(folder), env, ALGO)
    finally:
        env.close()


def best_lap(folder: Path) -> tuple[list[Timestep], slice, float | None]:
    """Drive some laps; return the drive, where in it the best lap is, and its time in seconds."""
    with car_and_driver(folder) as (env, driver):
        timesteps = list(drive(env, driver, seed=0))
    best, seconds, first = slice(0, len(timesteps)), None, 0
    for number, timestep in enumerate(timesteps):
        lap_time = timestep.info["lap_time"]
        if not lap_time:
            continue
        if seconds is None or lap_time < seconds:
            best, seconds = slice(first, number + 1), lap_time
        first = number + 1
    return timesteps, best, seconds


def draw(folder: Path) -> str:
    from sb3_torcs.tracks.catalogue import load_track
    from sb3_torcs.tracks.plot import plot_track

    timesteps, lap, seconds = best_lap(folder)
    cars = [timestep.car for timestep in timesteps[lap]]
    line = np.array([(car.x, car.y) for car in cars])
    speed = np.array([car.speed_x for car in cars])
    plot_track(load_track(TRACK), folder / PICTURE, line=line, speed=speed)
    return f"{folder / PICTURE}: {described(seconds, timesteps)}"


def video(folder: Path) -> str:
    from sb3_torcs.rendering.encoder import write_video

    timesteps, lap, seconds = best_lap(folder)
    with car_and_driver(folder, render_mode="rgb_array") as (env, driver):
        # The same drive again: it is deterministic.
        frames = (
            env.render()
            for number, _ in enumerate(drive(env, driver, seed=0))
            if lap.start <= number < lap.stop
        )
        fps = env.unwrapped.metadata["render_fps"]
        write_video(folder / VIDEO, frames, fps, lap.stop - lap.start)
    return f"{folder / VIDEO}: {described(seconds, timesteps)}"


def described(seconds: float | None, timesteps: list[Timestep]) -> str:
    if seconds is not None:
        return f"its best lap of {LAPS}, {seconds:.2f} s"
    return f"no whole lap yet: {timesteps[-1].car.distance_raced:.0f} m"


def last_words(folder: Path) -> str:
    """Say what there is, how to open it, and how to go on."""
    wanted, done = read_state(folder)
    lines = [""]
    laps = ["--env", ENV, "--track", TRACK, "--laps", str(LAPS)]
    for name, what, command in (
        (MODEL, "the best model by evaluation", [tool("sb3-torcs"), "evaluate", MODEL, *laps]),
        (TENSORBOARD, "how it learned", [tool("tensorboard"), "--logdir", TENSORBOARD]),
        (VIDEO, "its best drive, seen from above", ["xdg-open", VIDEO]),
        (PICTURE, "the line it drove, coloured by speed", ["xdg-open", PICTURE]),
    ):
        path = str(folder / name)
        if (folder / name).exists():
            command = [path if word == name else word for word in command]
            lines += [f"{path}: {what}", f"    {shlex.join(command)}"]
    if wanted is None or not done:
        lines.append(f"Nothing was learned yet. Begin with: {again(folder, '--fresh')}")
        return "\n".join(lines)
    lines.append(f"\nLearned from {done:,} of {wanted:,} timesteps.")
    more = "--continue" if done < wanted else f"--continue --timesteps {2 * wanted}"
    lines += [f"Go on:      {again(folder, more)}", f"Start over: {again(folder, '--fresh')}"]
    return "\n".join(lines)


def tool(name: str) -> str:
    """Where a command of this Python is, as one types it here."""
    path = Path(sys.executable).parent / name
    relative = os.path.relpath(path)
    return name if not path.exists() else str(path) if relative.startswith("..") else relative


def again(folder: Path, how: str) -> str:
    where = "" if folder == Path("demo") else f" --folder {folder}"
    words = f"{how}{where}"
    return f"make demo DEMO_ARGS={shlex.quote(words)}"


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Sb3TorcsError as error:
        sys.exit(f"error: {error}")
