"""Studies: every variant with every seed, as trials of Ray Tune on the local cores or a cluster.

Each trial stores its state in the study's folder, which is a Ray actor on the machine that runs the
command. A trial that is begun again, because its worker was lost or the study was killed, continues
from that state. Workers need no shared disk.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
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
from sb3_torcs.signals import EXIT_STATUS, answered, handlers_kept
from sb3_torcs.studies.config import Study, Trial
from sb3_torcs.studies.storage import Files, StudyFolder

__all__ = ["Progress", "require_ray", "run_study", "run_trial"]

RETRIES = 3  # retries of a trial whose worker was lost or whose code failed, per run of the command
SESSION = ".session"  # where a killed run's temporary files are
SCRATCH = "st-"  # prefix of folders for temporary files; short, since paths of sockets are limited
MARK = ".of-a-study"  # a file that names the folder for temporary files
PATIENCE = 30.0  # [s] until a folder for temporary files counts as one that cannot be removed
REPLACED = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR1") if hasattr(signal, name)
]
"""Signals whose handlers Ray replaces; Windows has no SIGUSR1."""
GRACE = 20.0  # [s] that Ray has to end after SIGTERM
STARTS = 10  # attempts: Ray gives its own processes 15 s, too little on a busy machine
PRIVATE = "sb3_torcs_study"  # a resource that marks a Ray that was started by a study
FAILED = "failed"  # the phase of a row with an error instead of a race

Progress = Callable[[Trial, dict[str, Any]], None]
"""Called with a trial and the last of its rows, or with ``{"state": …}``."""

QUIET = {
    "RAY_AIR_NEW_OUTPUT": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_worker_register_timeout_seconds": "600",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_WARN_THRESHOLD_S": "1000000",
}
"""Ray shall phone nobody, write no logs of its own, and leave the working folder alone.
Its workers may take long to start."""


IMPATIENT = {"RAY_NUM_REDIS_GET_RETRIES": "1"}
"""A cluster that does not answer is told within a minute; Ray would try for eight."""


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
            # Ray and Tune replace these handlers and never put them back.
            kept = handlers_kept(*REPLACED)
            with kept, _ray(store, jobs, address, signals) as scratch:
                _tune(left, store, scratch, tell)
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
    settings = QUIET if address is None else {**QUIET, **IMPATIENT}
    for name, value in settings.items():
        os.environ.setdefault(name, value)
    try:
        import ray.tune  # noqa: F401
    except ImportError as error:
        raise RayUnavailable(
            f"a study needs Ray Tune, which does not import ({error}); type: {install_line('ray')}"
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
        del frame
        if signals is not None:
            signals.append(number)
        _end(enough)

    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options.update(
            address="local", num_cpus=jobs or cores.number(),
            include_dashboard=False, _temp_dir=str(scratch), resources={PRIVATE: 1},
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
        except Exception as error:  # what it waited for in vain is of no other class
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
        # Tune handles Ctrl-C; Ray would treat SIGTERM as a crash.
        with answered(end, signal.SIGTERM):
            yield scratch
    finally:
        ray.shutdown()
        enough.cancel()
        _remove_folder(scratch)
        session.unlink(missing_ok=True)


def with_patience(start: Callable[[], Any]) -> Any:
    """
    Start Ray, again if its own processes were not there in time.

    :param start: starts it
    :return: what that returns
    """
    for _ in range(STARTS - 1):
        try:
            return start()
        except Exception as error:
            if "timed out" not in str(error).lower():
                raise
    return start()


def _end(enough: threading.Timer) -> None:
    """
    End as at Ctrl-C. Ray cannot if its own processes have had the signal, too, as by `timeout`.

    :param enough: what ends this process by force
    """
    with contextlib.suppress(RuntimeError):  # a second signal
        enough.start()
    signal.raise_signal(signal.SIGINT)


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


def _tune(trials: list[Trial], store: StudyFolder, scratch: Path, progress: Progress) -> None:
    """Let Ray Tune run the trials."""
    import ray
    from ray import tune
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    folder = ray.remote(StudyFolder).options(num_cpus=0, scheduling_strategy=here)
    actor = folder.remote(store.path, store.study)

    def trainable(config: dict[str, Any]) -> None:
        if scratch.is_dir():  # on this machine: what a killed worker leaves is removed with it
            tempfile.tempdir = str(scratch)
        with cores.at_most(1):  # on the others train other trials
            _run_or_tell(trials[config["trial"]], _Remote(actor), tune.report)

    here_only = _HereOnly(progress)

    class Watch(tune.Callback):
        """Passes the reports of Ray Tune to the progress function."""

        def on_trial_start(self, **heard: Any) -> None:
            here_only.call(trials[heard["trial"].config["trial"]], {"state": "running"})

        def on_trial_result(self, **heard: Any) -> None:
            trial, row = trials[heard["trial"].config["trial"]], heard["result"]
            here_only.call(trial, row)
            if row["phase"] == "final":
                here_only.call(trial, {"state": "done"})
            elif row["phase"] == FAILED:
                here_only.call(trial, {"state": "failed"})

    results = tune.Tuner(
        tune.with_resources(trainable, {"cpu": 1}),
        param_space={"trial": tune.grid_search(list(range(len(trials))))},
        run_config=tune.RunConfig(
            name="trials",
            storage_path=str(scratch),
            verbose=0,
            callbacks=[Watch()],
            failure_config=tune.FailureConfig(max_failures=RETRIES),
        ),
    ).fit()
    # A trial that was still waiting at Ctrl-C has no config.
    found = [results[number] for number in range(len(results))]
    errors = {result.config["trial"]: _error(result) for result in found if result.config}
    for number, trial in enumerate(trials):
        if store.ended(trial):
            progress(trial, {"state": "done"})
        elif errors.get(number) is None:
            progress(trial, {"state": "stopped"})
        else:
            progress(trial, {"state": "failed", "error": errors[number]})


def _run_or_tell(trial: Trial, store: Any, report: Callable[[dict[str, Any]], None]) -> None:
    """Run a trial. An error that would recur is reported as a row, so that Tune does not retry."""
    try:
        run_trial(trial, store, report)
    except (InvalidOption, OutputNotWritable, StudyError, TrackFileError, TrackNotFound) as error:
        report({"phase": FAILED, "error": _last_line(error)})


def _nobody(trial: Trial, row: dict[str, Any]) -> None:
    """Watch nothing."""
    del trial, row


def _error(result: Any) -> str | None:
    """Return why a trial failed: its own message, or the last line of a worker's traceback."""
    if result.error is not None:
        return _last_line(result.error)
    said: str | None = (result.metrics or {}).get("error")
    return said


def _last_line(error: Exception) -> str:
    """Return what a worker's traceback ends with."""
    return str(error).strip().splitlines()[-1]


class _HereOnly:
    """A callback for this process only: Ray Tune pickles it as one that does nothing."""

    def __init__(self, call: Callable[..., None] | None = None) -> None:
        self.call: Any = call

    def __reduce__(self) -> tuple[Any, ...]:
        return (_HereOnly, ())


class _Remote:
    """A Ray actor whose methods are called like those of a local object."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def __getattr__(self, name: str) -> Callable[..., Any]:
        import ray

        return lambda *args: ray.get(getattr(self._actor, name).remote(*args))
