"""``sb3-torcs study``: train and measure many agents, on the local cores or a Ray cluster."""

from __future__ import annotations

import argparse
import contextlib
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.cli.common import INTERRUPTED, positive, print_json, quiet_output
from sb3_torcs.files import writable_folder
from sb3_torcs.signals import EXIT_STATUS

if TYPE_CHECKING:
    from sb3_torcs.studies.config import Study, Trial

__all__ = ["Board", "add_parser", "run"]

REFRESHES = 2  # [1/s] of the table
COLUMNS = ("variant", "seed", "timesteps", "laps", "best lap s", "completes", "state")

DESCRIPTION = """\
Run a study: train every variant with every seed, evaluate it while it learns, and measure its best
model on the study's tracks. docs/studies.md describes FILE and the results.

Ctrl-C, a kill or the loss of a machine of a cluster loses at most what was learned since the last
evaluation. The same command then continues the study, and comes to the same results.
"""


def add_parser(subparsers: Any) -> None:
    """
    :param subparsers: of the command
    """
    parser = subparsers.add_parser(
        "study",
        help="train and measure many agents: variants by seeds, on all cores or a cluster",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("file", nargs="?", metavar="FILE.yml", help="e.g. examples/studies/smoke.yml")
    add(
        "--report",
        metavar="FOLDER",
        help="instead of running a study, write its learning curves and tables, with every seed: "
        "report.html, a page that works offline, and report.md with pictures. It may still run",
    )
    add("--output", metavar="DIR", help="folder of the report; default: that of the study")
    add("--folder", metavar="DIR", help="folder of the results; default: logs/studies/NAME")
    where = parser.add_mutually_exclusive_group().add_argument
    where("--jobs", type=positive, metavar="N", help="agents at a time; default: one per core")
    where(
        "--address",
        metavar="A",
        help="address of a Ray cluster that this machine belongs to, or auto",
    )
    add("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    :param args: from the command line
    :return: the exit status
    """
    from sb3_torcs.errors import InvalidOption

    if (args.report is None) == (args.file is None):
        raise InvalidOption("name a study, FILE.yml, or a folder of results: --report FOLDER")
    if args.report is not None:
        return _report(Path(args.report).expanduser(), args.output)
    from sb3_torcs.studies.config import read_study
    from sb3_torcs.studies.runner import require_ray, run_study
    from sb3_torcs.studies.storage import StudyFolder

    require_ray(args.address)
    study = read_study(args.file)
    folder = writable_folder(args.folder or Path("logs") / "studies" / study.name)
    board = Board(study)
    interrupted = contextlib.suppress(KeyboardInterrupt)
    signals: list[int] = []
    with interrupted, quiet_output(args.json), board.shown():
        run_study(
            study, folder, jobs=args.jobs, address=args.address, progress=board.update,
            signals=signals,
        )  # fmt: skip
    store = StudyFolder(folder, study)
    left = [trial for trial in study.trials if not store.ended(trial)]
    failed = board.errors()
    diverged = {trial.name: store.diverged(trial) for trial in study.trials}
    if args.json:
        lines = board.as_json(diverged)
        print_json({"study": study.name, "results": str(store.results), "trials": lines})
    else:
        for name, why in diverged.items():
            if why is not None:
                print(f"{name}: {why}; the results are those of its best model of before, if any")
        for name, error in failed.items():
            print(f"{name} failed: {error}")
        ended = len(study.trials) - len(left)
        print(f"{ended} of {len(study.trials)} agents trained and measured")
        if store.results.is_file():
            print(f"results: {store.results}")
        report = shlex.join(["sb3-torcs", "study", "--report", str(folder)])
        print("go on with:" if left else "see them:")
        print(f"  {_command(args) if left else report}")
    if len(left) > len(failed):
        return EXIT_STATUS + signals[0] if signals else INTERRUPTED
    return int(bool(failed))


def _report(folder: Path, output: str | None) -> int:
    """Write the report of a study."""
    from sb3_torcs.studies.report import write_report

    report = write_report(folder, Path(output).expanduser() if output else folder)
    print(report)
    print(report.with_suffix(".html"))
    return 0


def _command(args: argparse.Namespace) -> str:
    """Compose the command that continues the study."""
    words = ["sb3-torcs", "study", args.file]
    for name in ("folder", "jobs", "address"):
        if getattr(args, name) is not None:
            words += [f"--{name}", str(getattr(args, name))]
    return shlex.join(words)


class Board:
    """
    The progress and the best lap of each trial: a table on a terminal, elsewhere a line for each
    trial that begins or ends.

    :param study: whose trials they are
    """

    def __init__(self, study: Study) -> None:
        self._study = study
        self._tell: Callable[[str], None] | None = None  # where there is no terminal
        self._rows: dict[str, dict[str, Any]] = {
            trial.name: {"state": "waits", "decisions": 0} for trial in study.trials
        }

    def update(self, trial: Trial, row: dict[str, Any]) -> None:
        """
        Take a new result.

        :param trial: which one
        :param row: of its results, or its state
        """
        line = self._rows[trial.name]
        before = line["state"]
        line.update({key: row[key] for key in ("state", "error") if key in row})
        if self._tell is not None and line["state"] != before:
            self._tell(_told(trial, line))
        if row.get("phase") == "train":
            line["decisions"] = row["decisions"]
            if row["kept"]:
                line.update({key: row[key] for key in ("laps", "completes", "best_flying_lap_s")})

    def errors(self) -> dict[str, str]:
        """Return the messages of the trials that failed, by name."""
        return {name: row["error"] for name, row in self._rows.items() if "error" in row}

    def as_json(self, diverged: Mapping[str, str | None]) -> list[dict[str, Any]]:
        """
        Return the lines as plain values.

        :param diverged: why trainings ended early, by name
        """
        return [
            {
                "variant": trial.variant,
                "seed": trial.seed,
                **self._rows[trial.name],
                "diverged": diverged[trial.name],
            }
            for trial in self._study.trials
        ]

    @contextlib.contextmanager
    def shown(self) -> Iterator[None]:
        """Keep standard error up to date. Who reads it may leave: the study goes on."""
        from rich.console import Console
        from rich.live import Live

        from sb3_torcs.callbacks.display import Unbroken

        console = Console(stderr=True)
        if not console.is_terminal:
            self._tell = partial(print, file=Unbroken(sys.stderr), flush=True)
            yield
            return
        # Drawn by the clock and not for each row: a continued study reads hundreds of rows at once.
        with Live(get_renderable=self._table, console=console, refresh_per_second=REFRESHES):
            yield

    def _table(self) -> Any:
        from rich.table import Table

        table = Table(*COLUMNS, title=self._study.name, box=None)
        for trial in self._study.trials:
            row = self._rows[trial.name]
            lap, completes = row.get("best_flying_lap_s"), row.get("completes")
            table.add_row(
                trial.variant,
                str(trial.seed),
                f"{row['decisions']} / {trial.budget}",
                str(row.get("laps", "")),
                f"{lap:.3f}" if lap else "",
                {None: "", True: "yes", False: "no"}[completes],
                row["state"],
            )
        return table


def _told(trial: Trial, line: Mapping[str, Any]) -> str:
    """Compose the line of a trial whose state has changed."""
    said = f"{trial.name}: {line['state']}, {line['decisions']} of {trial.budget} timesteps"
    if "laps" in line:
        said += f", laps {line['laps']}"
    if line.get("best_flying_lap_s"):
        said += f", best lap {line['best_flying_lap_s']:.3f} s"
    return said
