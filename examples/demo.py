"""Watch a car learn to lap aalborg, in three minutes: `make demo` runs this.

It learns in the game if TORCS is installed, and on TorcsLite-v0 otherwise. Ctrl-C at any time keeps
what was learned; a second run continues, or starts over as asked.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_torcs.agents.models import find_model, load_driver, saved_timesteps, training_record
from sb3_torcs.backends.native import check_layout
from sb3_torcs.callbacks.lines import draw_learning, driven_laps
from sb3_torcs.callbacks.progress import spoken_moment
from sb3_torcs.cli.common import positive, seed
from sb3_torcs.errors import BackendUnavailable, OutputNotWritable, ends_in_a_line
from sb3_torcs.evaluation.pictures import BestLap, best_lap, draw_line, save_video
from sb3_torcs.evaluation.protocol import evaluate, race_environment
from sb3_torcs.evaluation.ticks import log_drives
from sb3_torcs.files import writable_folder
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.training.run import TrainOptions, train_run

TRACK = "aalborg"
ALGO, ENTRY = "ppo", "Torcs-v0"  # also on TorcsLite-v0, where no other entry learns to lap as fast
TIMESTEPS = 1_024_000
EVALUATIONS = 25  # of a whole training
ROLLOUT = 2048  # timesteps that PPO learns from at once
LAPS = 3  # the best of these is shown

STATE, LOG, RUNS = "demo.json", "training.log", "runs"
MODEL, LAST_MODEL, TENSORBOARD = "model.zip", "last_model.zip", "tensorboard"
VIDEO, PICTURE, CURVE, LINES = "lap.mp4", "line.png", "learning.png", "lines"
EVERYTHING = (
    STATE, LOG, RUNS, MODEL, LAST_MODEL, TENSORBOARD, VIDEO, PICTURE, CURVE, LINES
)  # fmt: skip


def main(words: list[str] | None = None) -> int:
    args = parse(words)
    folder = args.folder
    wanted, done = read_state(folder)
    plan = choose(args, wanted, done)
    if plan == "fresh":
        clear(folder)
        wanted, done = None, 0
    if plan != "show":
        wanted = args.timesteps or wanted or TIMESTEPS
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
    except (ValueError, KeyError, TypeError):  # a full disk cut the file off
        wanted = TIMESTEPS
    return wanted, sum(saved_timesteps(find_model(run, prefer_last=True)) for run in runs(folder))


class Course(NamedTuple):
    """What learns, and where."""

    algo: str
    env: str
    entry: str | None  # of the algorithm's hyperparameter file; None is the environment's own


def course_of(folder: Path) -> Course:
    """Return the course that was begun in this folder, or else the best one for this machine."""
    begun = runs(folder)
    if begun:
        algo, env = begun[0].parent.name, begun[0].name.rpartition("_")[0]
        return Course(algo, env, ENTRY if algo == ALGO else None)
    return Course(ALGO, choose_world(), ENTRY)


def choose_world() -> str:
    """Return the game's environment if it runs here, and the other one otherwise."""
    try:
        check_layout(find_game())
    except BackendUnavailable:
        return "TorcsLite-v0"
    return "Torcs-v0"


def runs(folder: Path) -> list[Path]:
    """List the zoo's folders that hold a model, oldest first."""
    usable = [
        run
        for run in (folder / RUNS).glob("*/*_*")
        if (run / f"{run.name.rpartition('_')[0]}.zip").is_file() or best_of(run).is_file()
    ]
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


def train(folder: Path, wanted: int, done: int, seed: int) -> bool:
    """Learn from the timesteps that are still wanted; say whether Ctrl-C or SIGTERM ended it."""
    before, course = runs(folder), course_of(folder)
    (folder / STATE).write_text(json.dumps({"timesteps": wanted}))
    options = TrainOptions(
        algo=course.algo,
        env=course.env,
        entry=course.entry,
        track=TRACK,
        timesteps=wanted - done,
        seed=seed + len(before),  # the same seed again would repeat the same episodes
        folder=folder / RUNS,
        tensorboard=folder / TENSORBOARD,
        eval_freq=max(wanted // EVALUATIONS, ROLLOUT),
        resume=find_model(before[-1], prefer_last=True) if before else None,
        pictures=folder / LINES,
    )
    print("\n".join(first_words(folder, course, wanted - done, bool(before))), flush=True)
    try:
        # The zoo's tables would break the progress bar.
        with (folder / LOG).open("a", buffering=1) as log, contextlib.redirect_stdout(log):
            interrupted = train_run(options).signal is not None
    except KeyboardInterrupt:  # before the first timestep, or a third time
        interrupted = True
    return interrupted


def first_words(folder: Path, course: Course, timesteps: int, again: bool) -> list[str]:
    """Say what begins now."""
    if course.env == "Torcs-v0":
        where = "in TORCS itself"
    else:
        where = f"on {course.env}, which needs no TORCS (`make game` gets it)"
    verb = "goes on learning" if again else "learns from nothing"
    return [
        f"{course.algo.upper()} {verb} to drive {TRACK}, {where}.",
        f"{timesteps:,} timesteps; log: {folder / LOG}; pictures of its line: {folder / LINES}/",
        "Each evaluation says how far the car comes from the grid, or the time of its first lap.",
        "Ctrl-C keeps what was learned so far.",
        "",
    ]


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
        "the curve": curve,
        "the picture": draw,
        "the video": video,
    }
    return not all([attempt(name, step, folder) for name, step in steps.items()])


def attempt(name: str, step: Callable[[Path], str], folder: Path) -> bool:
    """Do one part of the show; if it fails, the others still run."""
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


def curve(folder: Path) -> str:
    draw_learning(folder / LINES, folder / CURVE)
    first = next((lap for lap in driven_laps(folder / LINES) if lap.lap_time), None)
    told = f", the first whole lap after {spoken_moment(first.seconds)}" if first else ""
    return f"{folder / CURVE}: how it learned{told}"


def driven(folder: Path) -> BestLap:
    """Drive some laps from the grid with the best model, and return the best one."""
    model = best_model(folder)
    record = training_record(model)
    with race_environment(course_of(folder).env, record.env_kwargs, laps=LAPS) as env:
        log = log_drives(env, "demo")
        evaluate(env, load_driver(model, env))
    return best_lap(log)


def draw(folder: Path) -> str:
    lap = driven(folder)
    draw_line(lap, folder / PICTURE)
    return f"{folder / PICTURE}: {described(lap)}"


def video(folder: Path) -> str:
    lap = driven(folder)
    save_video(lap, folder / VIDEO, None)
    return f"{folder / VIDEO}: {described(lap)}"


def described(lap: BestLap) -> str:
    if lap.time is not None:
        return f"its best lap of {LAPS}, {lap.time:.2f} s"
    return f"no whole lap yet: {lap.distance:.0f} m"


def last_words(folder: Path) -> str:
    """Say what the demo made, how to open it, and how to continue."""
    wanted, done = read_state(folder)
    lines = [""]
    sb3_torcs, env = tool("sb3-torcs"), course_of(folder).env
    laps = ["--env", env, "--track", TRACK, "--laps", str(LAPS)]
    for name, what, command in (
        (MODEL, "the best model by evaluation", [sb3_torcs, "evaluate", MODEL, *laps]),
        (
            TENSORBOARD,
            "how it learned, in figures",
            [tool("tensorboard"), "--logdir", TENSORBOARD],
        ),
        (CURVE, "how it learned", ["xdg-open", CURVE]),
        (PICTURE, "the line it drives, coloured by speed", ["xdg-open", PICTURE]),
        (VIDEO, "its best drive, seen from above", ["xdg-open", VIDEO]),
    ):
        path = str(folder / name)
        if (folder / name).exists():
            command = [path if word == name else word for word in command]
            lines += [f"{path}: {what}", f"    {shlex.join(command)}"]
    if wanted is None or not done:
        lines.append(f"Nothing was learned yet. Begin with: {again(folder, '--fresh')}")
        return "\n".join(lines)
    if env == "Torcs-v0":
        watch = shlex.join([sb3_torcs, "watch", str(folder / MODEL)])
        lines += ["In the game's own window:", f"    {watch}"]
    lines.append(f"\nLearned from {done:,} of {wanted:,} timesteps.")
    more = "--continue" if done < wanted else f"--continue --timesteps {2 * wanted}"
    lines += [f"Go on:      {again(folder, more)}", f"Start over: {again(folder, '--fresh')}"]
    return "\n".join(lines)


def tool(name: str) -> str:
    """Return a command of this Python as one types it here."""
    path = Path(sys.executable).parent / name
    relative = os.path.relpath(path)
    return name if not path.exists() else str(path) if relative.startswith("..") else relative


def again(folder: Path, how: str) -> str:
    where = "" if folder == Path("demo") else f" --folder {shlex.quote(str(folder))}"
    words = f"{how}{where}"
    return f"make demo DEMO_ARGS={shlex.quote(words)}"


if __name__ == "__main__":
    with ends_in_a_line():
        sys.exit(main())
