"""Studies: every variant with every seed, as tasks of Ray on the local cores or a cluster.

Each trial stores its state in the study's folder, which is a Ray actor on the machine that runs the
command. A trial that is begun again, because its worker was lost or the study was killed, continues
from that state. Workers need no shared disk.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from sb3_torcs import cores
from sb3_torcs.agents.saved.record import BEST_MODEL
from sb3_torcs.errors import (
    InvalidOption,
    OutputNotWritable,
    RayUnavailable,
    StudyError,
    TrackFileError,
    TrackNotFound,
    TrainingDiverged,
    install_line,
)
from sb3_torcs.signals import EXIT_STATUS, keep_handlers, on_signal
from sb3_torcs.studies.config import Study, Trial
from sb3_torcs.studies.storage import Files, StudyFolder

__all__ = ["Progress", "require_ray", "run_study", "run_trial"]

RETRIES = 3  # of a trial whose worker was lost or whose code failed, per run of the command
LOOK = 0.2  # [s] between two looks at how far the trials are
SESSION = ".session"  # where a killed run's temporary files are
SCRATCH = "st-"  # prefix of folders for temporary files; short, since paths of sockets are limited
MARK = ".of-a-study"  # a file that names the folder for temporary files
PATIENCE = 30.0  # [s] until a folder for temporary files counts as one that cannot be removed
GRACE = 20.0  # [s] that Ray has to end after SIGTERM
STARTS = 10  # attempts: Ray gives its own processes 15 s, too little on a busy machine
PRIVATE = "sb3_torcs_study"  # a resource that marks a Ray that was started by a study

LASTING = (InvalidOption, OutputNotWritable, StudyError, TrackFileError, TrackNotFound)
"""Errors that would come again: a trial that meets one is not tried once more."""

Progress = Callable[[Trial, dict[str, Any]], None]
"""Called with a trial and the last of its rows, or with ``{"state": …}``."""

SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # it shall phone nobody
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # else it warns
    # On a busy machine its parts need longer than Ray waits for them.
    "RAY_DASHBOARD_STARTUP_TIMEOUT_S": "600",
    "RAY_gcs_server_port_wait_time_s": "120",
    "RAY_worker_register_timeout_seconds": "600",
}

TOKEN = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
"""Ray listens at all network addresses of the machine, and its tasks run any code: those of a study
answer this process alone."""

IMPATIENT = {"RAY_NUM_REDIS_GET_RETRIES": "1"}
"""A cluster that does not answer is reported within a minute; Ray would try for eight."""


def run_trial(trial: Trial, store: Any, report: Callable[[dict[str, Any]], None]) -> None:
    """
    Train and measure one agent, or continue it.

    :param trial: which one
    :param store: a :class:`~sb3_torcs.studies.storage.StudyFolder`, or its proxy on another
        machine
    :param report: called with the newest row
    """
    from sb3_torcs.studies.rows import final_row, rows_of_nothing, training_rows
    from sb3_torcs.training.trial import Training

    files, over, missing = store.state(trial)
    if not over:
        with _unpacked(files) as checkpoint:
            training = Training(trial, checkpoint)

        def after_slice() -> None:
            with tempfile.TemporaryDirectory() as scratch:
                training.save(Path(scratch))
                packed = {file.name: file.read_bytes() for file in Path(scratch).iterdir()}
            rows = training_rows(trial, training)
            store.put(trial, packed, rows)
            report(rows[-1])

        with contextlib.closing(training):
            try:
                training.run(after_slice)
            except TrainingDiverged as error:
                store.put_diverged(trial, str(error), rows_of_nothing(trial, training))
                report(store.rows(trial)[-1])
        files, _, missing = store.state(trial)
    chosen = [row for row in store.rows(trial) if row["phase"] == "train" and row["kept"]][-1]
    with _unpacked(files) as folder:
        assert folder is not None
        model = folder / BEST_MODEL
        for track in missing:
            row = final_row(trial, model, track, chosen)
            store.put_finals(trial, [row])
    if missing:
        report(row)


@contextlib.contextmanager
def _unpacked(files: Files | None) -> Iterator[Path | None]:
    """Write files to a temporary folder."""
    if files is None:
        yield None
        return
    with tempfile.TemporaryDirectory() as scratch:
        for name, content in files.items():
            (Path(scratch) / name).write_bytes(content)
        yield Path(scratch)


def run_study(
    study: Study,
    folder: Path,
    *,
    jobs: int | None = None,
    address: str | None = None,
    progress: Progress | None = None,
    signals: list[int] | None = None,
) -> Path:
    """
    Run a study, or continue it.

    :param study: what is to be run
    :param folder: of the study; results in it are not computed again
    :param jobs: trials at a time on this machine; by default one per core
    :param address: of a Ray cluster that this machine belongs to; ``None`` uses this machine alone
    :param progress: called with each new result of a trial
    :param signals: gets the number of each SIGTERM, which ends the study as Ctrl-C does
    :return: the table of the results
    :raises RayUnavailable: if Ray is missing, or the cluster does not answer
    :raises StudyError: if the folder is of another study, or in use, or if a variant cannot be
        built
    """
    require_ray(address)
    tell = progress or _nobody
    store = StudyFolder(folder, study)
    with store.locked():
        _remove_scratch(store.path / SESSION)  # of a run that was killed
        left = [trial for trial in study.trials if not store.ended(trial)]
        for trial in {trial.variant: trial for trial in left}.values():
            _check_buildable(trial, study.path)
        store.begin()
        store.write_results()
        for trial in study.trials:
            for row in store.rows(trial):
                tell(trial, row)
            if trial not in left:
                tell(trial, {"state": "done"})
        if left:
            # Ray replaces this handler and never puts it back.
            kept = keep_handlers(signal.SIGTERM)
            with kept, _ray(store, jobs, address, signals) as scratch:
                _train_all(left, store, scratch, tell)
    return store.results


def _check_buildable(trial: Trial, file: Path) -> None:
    """Build the agent of a trial, so that wrong values are reported before any training."""
    from sb3_torcs.training.trial import Training

    try:
        Training(trial).close()
    except Exception as error:
        raise StudyError(f"{file}: variant '{trial.variant}' cannot be trained: {error}") from error


def require_ray(address: str | None = None) -> None:
    """
    Make sure that Ray can be imported, and silence it.

    :param address: of a cluster that is to be joined
    :raises RayUnavailable: if it is not installed, or the address is not one of a cluster
    """
    if address is not None and address.startswith("ray://"):
        raise RayUnavailable(
            f"'{address}' is for clients outside of a cluster; type the command on one of its "
            "machines, with --address auto"
        )
    settings = {**SETTINGS, **(TOKEN if address is None else IMPATIENT)}
    for name, value in settings.items():
        os.environ.setdefault(name, value)
    try:
        import ray  # noqa: F401
    except ImportError as error:
        raise RayUnavailable(
            f"a study needs Ray, which does not import ({error}); type: {install_line('ray')}"
        ) from error


@contextlib.contextmanager
def _ray(
    store: StudyFolder, jobs: int | None, address: str | None, signals: list[int] | None
) -> Iterator[Path]:
    """Start Ray or join a cluster, with a folder for temporary files, and clean up."""
    import ray

    if ray.is_initialized():
        raise RayUnavailable(
            "this process uses Ray already, and a study starts its own; call ray.shutdown() first, "
            "or run the study in another process"
        )
    session = store.path / SESSION
    scratch = Path(tempfile.mkdtemp(prefix=SCRATCH))
    enough = threading.Timer(GRACE, _end_by_force, (scratch, session))
    enough.daemon = True

    def end(number: int, frame: FrameType | None) -> None:
        """End as at Ctrl-C. Ray cannot if its own processes have had the signal, too."""
        del frame
        if signals is not None:
            signals.append(number)
        with contextlib.suppress(RuntimeError):  # a second signal
            enough.start()
        raise KeyboardInterrupt

    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options.update(
            address="local", num_cpus=jobs or cores.number(),
            include_dashboard=False, _temp_dir=str(scratch / "ray"), resources={PRIVATE: 1},
        )  # fmt: skip
    else:
        options["address"] = address
    try:
        try:
            (scratch / MARK).touch()
            session.write_text(str(scratch), encoding="utf-8")
            if address is None:
                with_patience(lambda: ray.init(**options))
            else:
                ray.init(**options)
        except Exception as error:  # Ray raises bare ones, too
            raise RayUnavailable(
                f"Ray does not start in '{scratch}' ({error}); is there room, is the path short, "
                "and is the machine not too busy? Otherwise choose another folder: TMPDIR=/tmp"
                if address is None
                else f"no Ray cluster at '{address}' ({error}); start one with `ray start --head` "
                "and give the address that it prints, or leave --address out"
            ) from error
        if address is not None and PRIVATE in ray.cluster_resources():
            raise RayUnavailable(
                f"the Ray at '{address}' belongs to another study, and ends with it; leave "
                "--address out, or start a cluster with `ray start --head`"
            )
        with on_signal(end, signal.SIGTERM):
            yield scratch
    finally:
        ray.shutdown()
        enough.cancel()
        _remove_folder(scratch)
        session.unlink(missing_ok=True)


def with_patience(start: Callable[[], Any]) -> Any:
    """
    Start Ray, again if its own processes were not there in the time that it gives them.

    :param start: starts it
    :return: what that returns
    """
    import ray

    for _ in range(STARTS - 1):
        try:
            return start()
        except (OSError, ValueError):  # for which time is no remedy
            raise
        except Exception:
            ray.shutdown()
    return start()


def _end_by_force(scratch: Path, session: Path) -> None:
    """End this process, with which Ray's own end, and leave nothing temporary."""
    _remove_folder(scratch)
    session.unlink(missing_ok=True)
    sys.stderr.write("sb3-torcs: ended; the same command goes on with the study\n")
    os._exit(EXIT_STATUS + signal.SIGTERM)


def _remove_scratch(session: Path) -> None:
    """Remove the temporary files of a run. The file that names them may be damaged."""
    if not session.is_file():
        return
    with contextlib.suppress(OSError, ValueError):  # damaged, or naming what cannot be
        folder = Path(session.read_text(encoding="utf-8"))
        if (folder / MARK).is_file():
            _remove_folder(folder)
    session.unlink()


def _remove_folder(folder: Path) -> None:
    """Remove a folder of Ray, whose processes may write into it while they end."""
    give_up = time.monotonic() + PATIENCE
    shutil.rmtree(folder, ignore_errors=True)
    while folder.exists() and time.monotonic() < give_up:
        time.sleep(0.1)
        shutil.rmtree(folder, ignore_errors=True)


class _Folder(StudyFolder):
    """The folder of a study as an actor, which collects what workers report."""

    def __init__(self, path: Path, study: Study) -> None:
        super().__init__(path, study)
        self._reports: list[tuple[Trial, dict[str, Any]]] = []

    def report(self, trial: Trial, row: dict[str, Any]) -> None:
        """Take the newest row of a trial, or its state."""
        self._reports.append((trial, row))

    def reports(self) -> list[tuple[Trial, dict[str, Any]]]:
        """Return what was reported since the last call."""
        taken, self._reports = self._reports, []
        return taken


def _train_all(trials: list[Trial], store: StudyFolder, scratch: Path, progress: Progress) -> None:
    """Let Ray train and measure the trials."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    kind = ray.remote(_Folder).options(num_cpus=0, scheduling_strategy=here)
    actor = kind.remote(store.path, store.study)
    task = ray.remote(_train).options(num_cpus=1, max_retries=RETRIES, retry_exceptions=True)
    running = {task.remote(trial, actor, scratch): trial for trial in trials}
    try:
        while running:
            ended, _ = ray.wait(list(running), timeout=LOOK)
            for trial, row in ray.get(actor.reports.remote()):
                progress(trial, row)
            for result in ended:
                error = _error(result)
                state = {"state": "done"} if error is None else {"state": "failed", "error": error}
                progress(running.pop(result), state)
    finally:  # Ctrl-C
        for trial in running.values():
            progress(trial, {"state": "done" if store.ended(trial) else "stopped"})


def _train(trial: Trial, actor: Any, scratch: Path) -> str | None:
    """Train and measure one agent on a worker; return an error that would come again."""
    if scratch.is_dir():  # on this machine: what a killed worker leaves is removed with it
        tempfile.tempdir = str(scratch)
    store = _Remote(actor)
    report = partial(store.report, trial)
    report({"state": "running"})
    try:
        with cores.at_most(1):  # on the others train other trials
            run_trial(trial, store, report)
    except LASTING as error:
        return _last_line(error)
    return None


def _error(result: Any) -> str | None:
    """Return why a trial failed: its own message, or the last line of a worker's traceback."""
    import ray

    try:
        found: str | None = ray.get(result)
        return found
    except ray.exceptions.RayError as error:
        return _last_line(error)


def _last_line(error: Exception) -> str:
    """Return what a worker's traceback ends with."""
    return str(error).strip().splitlines()[-1]


def _nobody(trial: Trial, row: dict[str, Any]) -> None:
    """Watch nothing."""
    del trial, row


class _Remote:
    """A Ray actor whose methods are called like those of a local object."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def __getattr__(self, name: str) -> Callable[..., Any]:
        import ray

        return lambda *args: ray.get(getattr(self._actor, name).remote(*args))
