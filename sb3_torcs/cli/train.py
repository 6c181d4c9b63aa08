"""``sb3-torcs train``: train with the RL Zoo and the shipped hyperparameters."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from typing import Any

from sb3_torcs.cli.common import positive, seed
from sb3_torcs.signals import EXIT_STATUS
from sb3_torcs.training.run import Run, TrainOptions, going_on, train_run

__all__ = ["add_parser", "run"]


EPILOG = """\
Arguments after -- go to the RL Zoo unchanged, and override ours:
  sb3-torcs train --timesteps 20000 -- --save-freq 5000 --hyperparams batch_size:64

Ctrl-C saves the model and prints the command that continues the training. A kill or a full disk
loses at most what was learned since the last evaluation.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "train",
        help="train an agent with the RL Zoo and the shipped hyperparameters",
        description="Train an agent with the RL Zoo and the shipped hyperparameters, which are "
        "checked before anything starts.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--algo",
        help="ddpg (default), td3, sac, a2c or ppo; with SBX also sbx_sac; others of the zoo with "
        "a --conf-file",
    )
    add("--env", metavar="ID", help="Torcs-v0, or by default TorcsLite-v0")
    add("--entry", metavar="NAME", help='block of the hyperparameter file, e.g. "as the post"; '
        "default: the one called as --env")  # fmt: skip
    add("--conf-file", metavar="FILE", help="hyperparameter file; default: the shipped one")
    add("--track", metavar="T", help="track; default: the entry's; `sb3-torcs tracks` lists them")
    add(
        "--timesteps",
        type=positive,
        metavar="N",
        help="timesteps to learn from; default: the entry's",
    )
    add("--seed", type=seed, default=0, metavar="S", help="default: 0")
    add("--folder", default="logs", help="folder of models and logs; default: logs")
    add("--tensorboard", metavar="DIR", help="default: FOLDER/tensorboard")
    add(
        "--eval-freq",
        type=int,
        metavar="N",
        help="timesteps between evaluations, 0 for none; default: a fortieth of --timesteps, and "
        "at least a rollout of PPO",
    )
    add(
        "--eval-episodes",
        type=positive,
        default=1,
        metavar="N",
        help="episodes per evaluation; default: 1",
    )
    add(
        "--resume",
        metavar="MODEL",
        help="continue from a saved model (.zip) or a run's folder, with its own hyperparameters, "
        "track and timesteps that are left, unless you give others; runs code that is pickled in "
        "model and replay buffer: only if you trust their author",
    )
    add(
        "--trust",
        action="store_true",
        help="accept a model without a record, and evaluate Python in the strings of the "
        "hyperparameter file: only if you trust their author",
    )
    add("--progress", action=argparse.BooleanOptionalAction, default=True, help="progress bar")
    add("--pictures", metavar="DIR", help="draw the line of an evaluation lap about once a minute")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    names = [field.name for field in dataclasses.fields(TrainOptions)]
    values = {name: getattr(args, name) for name in names}
    values.update(_trained_before(args), zoo_args=tuple(args.zoo_args))
    options = TrainOptions(**values)
    if args.entry is not None and args.env is None and args.resume is None:
        print(
            f"learning in {options.env}, which needs no game; --env Torcs-v0 is the game itself",
            file=sys.stderr,
        )
    result = train_run(options)
    print("\n".join(_closing_words(options, result)))
    return 0 if result.signal is None else EXIT_STATUS + result.signal


def _trained_before(args: argparse.Namespace) -> dict[str, str]:
    """Take algorithm and environment from the model to resume, unless they are given."""
    from sb3_torcs.agents.models import TrainingRecord, find_model, training_record

    record = TrainingRecord()
    if args.resume is not None:
        record = training_record(find_model(args.resume, prefer_last=True))
    return {
        "algo": args.algo or record.algo or TrainOptions.algo,
        "env": args.env or record.env_id or TrainOptions.env,
    }


def _closing_words(options: TrainOptions, result: Run) -> list[str]:
    """Name the files and the commands to type next."""
    from sb3_torcs.agents.saved.algorithm import SBX

    if result.last_model is None:
        return [f"the RL Zoo has searched; its reports: {result.folder / 'report_*.csv'}"]
    learned = f"learned from {result.timesteps} of {result.wanted} timesteps"
    lines = [f"{learned}; folder: {result.folder}"]
    evaluated = result.best_model != result.last_model
    lines += [f"best model by evaluation: {result.best_model}"] if evaluated else []
    lines += [f"last model: {result.last_model}"]
    if options.resume is not None:
        lines += [f"before that, which may be better still: {options.resume}"]
    if result.timesteps < result.wanted:
        lines += ["go on with:", f"  {going_on(options, result)}"]
    words = ["sb3-torcs", "evaluate", str(result.best_model), "--env", options.env]
    track, car = (result.env_kwargs.get(name) for name in ("track", "car"))
    if track:
        words += ["--track", track[0] if isinstance(track, list) else track]
    words += ["--car", car[0]] if isinstance(car, list) else []  # evaluate drives one of them
    words += ["--trust"] if options.algo.startswith(SBX) else []  # whose models are pickled
    lines += ["see what it learned:", f"  {shlex.join(words)}"]
    return lines
