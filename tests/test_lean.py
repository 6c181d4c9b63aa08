"""The core imports little, does without the extras, and runs where there is no POSIX."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_torcs.cli import requirements
from sb3_torcs.errors import EXTRAS, PackageMissing, check_extras, needs_extra
from sb3_torcs.files import import_advice

ROOT = Path(__file__).parent.parent

BLOCKED = """
import sys

class Without:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        hidden = name in NAMES or name.partition(".")[0] in NAMES
        return None if hidden else self.finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self.finder, name)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
for name in NAMES:
    sys.modules.pop(name, None)
"""
"""Hides modules, as if they were not installed."""

WITHOUT_EXTRAS = f"NAMES = {sorted(EXTRAS)}{BLOCKED}from sb3_torcs.cli import main\n"

AS_ON_WINDOWS = f"""
import asyncio, multiprocessing, os, signal, socket, subprocess, tempfile
import matplotlib, numba, platformdirs, rl_zoo3, stable_baselines3  # which know their system

NAMES = ["fcntl", "grp", "pwd", "resource", "termios", "sb3_torcs._engine"]{BLOCKED}
for module, names in (
    (os, "fork forkpty geteuid getgid getpgid getuid killpg memfd_create mkfifo nice pipe2 "
         "register_at_fork sched_getaffinity sched_setaffinity setsid"),
    (signal, "SIGALRM SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGUSR1 SIGUSR2 "
             "SIGXCPU alarm pause pthread_kill pthread_sigmask setitimer sigwait"),
    (socket, "AF_UNIX"),
):
    for name in names.split():
        delattr(module, name)
"""
"""Takes away the modules, functions and signals that Windows has not."""

TRAINING = """
import gymnasium as gym
from stable_baselines3 import PPO
import sb3_torcs
from sb3_torcs.callbacks import DrivingMetricsCallback, LeanUpdatesCallback, RecordCallback
from sb3_torcs.policies import BoundedPolicy
from sb3_torcs.vec_env import TorcsVecEnv
env = TorcsVecEnv([lambda: gym.make("TorcsLite-v0")] * 2)
callbacks = [DrivingMetricsCallback(), LeanUpdatesCallback(), RecordCallback()]
model = PPO(BoundedPolicy, env, n_steps=500, batch_size=250, seed=0, tensorboard_log="board")
model.learn(2000, callbacks)
assert model.num_timesteps == 2000
model.save("model")
"""


def python(code, folder, *words):
    """Run code in a process of its own; return exit status, standard output and error."""
    call = [sys.executable, "-c", code, *words]
    ended = subprocess.run(call, cwd=folder, capture_output=True, text=True, timeout=1200)
    return ended.returncode, ended.stdout, ended.stderr


def ended_well(code, folder):
    """Run code; return what it printed."""
    status, out, err = python(code, folder)
    assert status == 0, err
    return out


def loaded(code, folder):
    """The top names of the modules that code loads."""
    out = ended_well(f"{code}\nimport sys\nprint(*sys.modules, sep='\\n')", folder)
    return {name.partition(".")[0] for name in out.splitlines()}


HEAVY = {"highway_env", "matplotlib", "numba", "pandas", "rl_zoo3", "scipy", "tensorboard", "torch"}


@pytest.mark.parametrize(("code", "allowed"), [
    ("import sb3_torcs", set()),
    ("from sb3_torcs.cli import main; main([])", set()),
    ("from sb3_torcs.cli import main; main(['tracks'])", set()),
    ("from sb3_torcs.cli import main; main(['drivers'])", {"numba", "scipy"}),
    ("from sb3_torcs.cli import main; main(['doctor'])", {"numba", "scipy"}),
    ("from sb3_torcs.cli import main; main(['evaluate', 'ppo-aalborg', '--laps', '1'])",
     {"numba", "scipy", "tensorboard", "torch"}),
])  # fmt: skip
def test_nothing_heavy_is_loaded_needlessly(code, allowed, tmp_path):
    """numba loads SciPy, and Stable-Baselines3 TensorBoard."""
    assert loaded(code, tmp_path) & HEAVY <= allowed


def imported_packages():
    """Every package that a file of ours imports, inside functions too, but for types."""
    for path in (ROOT / "sb3_torcs").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in getattr(node, "names", [])]
            if isinstance(node, ast.ImportFrom):
                names = [node.module]
            if isinstance(node, ast.Import | ast.ImportFrom):
                yield from ((path, name.partition(".")[0]) for name in names)


def test_each_package_that_is_imported_is_the_cores_or_an_extras():
    """What is new here belongs to setup.cfg, and to EXTRAS if the core does without."""
    core = {
        "gymnasium", "highway_env", "llvmlite", "matplotlib", "numba", "numpy", "platformdirs",
        "rich", "scipy", "stable_baselines3", "torch", "tqdm", "yaml",
    }  # fmt: skip
    brought_by_these = {"PIL", "packaging", "pandas", "pygame"}
    known = {*core, *brought_by_these, *EXTRAS, "sb3_torcs", *sys.stdlib_module_names}
    assert {name for _, name in imported_packages()} - known == set()


@pytest.mark.slow
def test_the_core_does_without_the_extras(tmp_path, game):
    """Environments of both ids, a training with our policies and callbacks, and the verbs."""
    lines = [
        WITHOUT_EXTRAS,
        "import gymnasium as gym, sb3_torcs",
        "for name in ('TorcsLite-v0', 'Torcs-v0'):",
        "    with gym.make(name) as env:",
        "        env.reset(seed=0)",
        "        env.step(env.action_space.sample())",
        TRAINING,
        "for words in (['tracks'], ['drivers'], ['doctor'],",
        "              ['evaluate', 'model.zip', '--laps', '1'],",
        "              ['evaluate', 'ppo-aalborg', '--laps', '1', '--line', 'line.png']):",
        "    assert main(words) == 0, words",
    ]
    out = ended_well("\n".join(lines), tmp_path)
    assert list((tmp_path / "board").rglob("events*"))
    assert out.count("TorcsLite-v0, aalborg") == 1
    assert out.count("Torcs-v0, aalborg") == 1
    assert (tmp_path / "line.png").is_file()


NEEDS = [
    (["evaluate", "scripted", "--video", "a.mp4"], "imageio_ffmpeg"),
    (["evaluate", "scripted", "--telemetry", "a.parquet"], "pyarrow"),
    (["evaluate", "scripted", "--report", "a.html"], "plotly"),
    (["compare", "scripted"], "plotly"),
    (["evaluate", "inferno", "--telemetry", "a.parquet"], "pyarrow"),
    (["race", "scripted", "inferno"], "openskill"),
    (["watch", "scripted", "--video", "a.mp4"], "imageio_ffmpeg"),
    (["study", "--report", "."], "plotly"),
    (["study", "a.yml"], "ray"),
    (["-c", "import sb3_torcs; sb3_torcs.parallel_env"], "pettingzoo"),
]
EACH_IN_A_FORK = """
import json, os, pathlib, stable_baselines3
for number, words in enumerate(json.loads(sys.argv[1])):
    folder = pathlib.Path(str(number))
    folder.mkdir()
    if os.fork() == 0:
        for stream, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{number}.{name}", os.O_CREAT | os.O_WRONLY), stream)
        os.chdir(folder)
        exec(words[1]) if words[0] == "-c" else sys.exit(main(words))
        sys.exit(0)
    print(os.waitstatus_to_exitcode(os.wait()[1]))
"""
"""Stable-Baselines3 takes seconds to load, so that it is loaded once."""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What each of ``NEEDS`` ends with: exit status, standard output and error, files."""
    folder = tmp_path_factory.mktemp("needs")
    said = json.dumps([words for words, _ in NEEDS])
    _, out, err = python(WITHOUT_EXTRAS + EACH_IN_A_FORK, folder, said)
    assert err == ""
    texts = [[(folder / f"{n}.{name}").read_text() for name in ("out", "err")]
             for n in range(len(NEEDS))]  # fmt: skip
    return [
        (int(status), *text, list((folder / str(n)).iterdir()))
        for n, (status, text) in enumerate(zip(out.split(), texts, strict=True))
    ]


@pytest.mark.parametrize("number", range(len(NEEDS)))
def test_what_needs_an_extra_says_which_to_type(answers, number):
    words, package = NEEDS[number]
    status, out, err, written = answers[number]
    last = err.splitlines()[-1]
    assert status != 0
    assert out == ""
    assert last.endswith(f'; type: pip install "sb3-torcs[{EXTRAS[package]}]"')
    assert package in last.lower() or package == "ray"
    assert len(err.splitlines()) == 1 or words[0] == "-c"
    assert written == []


def test_a_missing_package_that_no_extra_brings_stays_an_error_of_python():
    with pytest.raises(ModuleNotFoundError, match="no_such_package") as raised, needs_extra("x"):
        import no_such_package  # noqa: F401
    assert not isinstance(raised.value, PackageMissing)


def test_a_package_of_an_extra_is_looked_for_without_its_import(monkeypatch):
    monkeypatch.delitem(sys.modules, "plotly", raising=False)
    check_extras("the report", "plotly")
    assert "plotly" not in sys.modules
    monkeypatch.setitem(sys.modules, "plotly", None)
    told = r'^the report needs plotly, .*; type: pip install "sb3-torcs\[reports\]"$'
    with pytest.raises(PackageMissing, match=told):
        check_extras("the report", "plotly")
    assert import_advice("rl_zoo3.wrappers") == 'type: pip install "sb3-torcs[zoo]"'


# what is installed


def requiring(monkeypatch, installed, *lines):
    """Let the package require these lines, and the machine have these versions."""

    def version(name):
        if name not in installed:
            raise requirements.metadata.PackageNotFoundError(name)
        return installed[name]

    monkeypatch.setattr(requirements.metadata, "requires", lambda _: list(lines))
    monkeypatch.setattr(requirements.metadata, "version", version)


def test_versions_are_compared_with_the_packages_own_requirements(monkeypatch):
    requiring(
        monkeypatch, {"numba": "0.59.1", "torch": "2.4.0+cpu"},
        "numba>=0.60", "torch>=2.4", "rich>=13", 'pywin32>=1; sys_platform == "win32"',
        'plotly>=6; extra == "reports"',
    )  # fmt: skip
    numba, torch, rich = requirements.check_core()
    assert (numba.ok, numba.found, numba.fix) == (
        False,
        "0.59.1; expected >=0.60",
        'pip install "numba>=0.60"',
    )
    assert torch == requirements.Check("torch", True, "2.4.0+cpu", None)
    assert rich == requirements.Check("rich", False, "not installed", 'pip install "rich>=13"')


def test_an_extra_may_be_missing_but_not_be_of_another_version(monkeypatch):
    requiring(
        monkeypatch, {"plotly": "5.1", "rl_zoo3": "2.9"},
        'plotly>=6; extra == "reports"', 'rl_zoo3>=2.7; extra == "zoo"',
        'sb3-contrib>=2.7; extra == "zoo"', 'sb3-torcs[reports]; extra == "study"',
        'rl_zoo3>=2.7; extra == "study"',
    )  # fmt: skip
    checks = {check.name: check for check in requirements.check_extras()}
    assert checks["extra reports"].found == "plotly 5.1; expected >=6"
    assert checks["extra reports"].fix == 'pip install "sb3-torcs[reports]"'
    assert checks["extra zoo"].ok
    assert checks["extra zoo"].found.startswith(
        'no sb3-contrib; type: pip install "sb3-torcs[zoo]"'
    )
    assert checks["extra study"] == requirements.Check("extra study", True, "rl_zoo3 2.9", None)


def test_each_extra_has_somebody_who_needs_it():
    assert set(requirements.USERS) == set(EXTRAS.values())


# without POSIX


IMPORT_ALL = """
import importlib, pkgutil, sb3_torcs
for module in pkgutil.walk_packages(sb3_torcs.__path__, "sb3_torcs."):
    if not module.name.rpartition(".")[2].startswith("_"):
        importlib.import_module(module.name)
"""
VERBS = """
from sb3_torcs.cli import main
words = ["evaluate", "model.zip", "--laps", "1", "--telemetry", "a.parquet", "--line", "a.png"]
assert main(words) == 0
words = ["evaluate", "scripted", "--env", "TorcsLite-v0", "--laps", "1", "--report", "a.html"]
assert main(words) == 0
assert main(["tracks"]) == 0
assert main(["doctor"]) == 1
assert main(["install-torcs", "--check"]) in (0, 1)
"""
MAIN = "from sb3_torcs.cli import main\nsys.exit(main(sys.argv[1:]))\n"


def test_every_module_imports_where_there_is_no_posix(tmp_path):
    """The compiled ones are not in a wheel without the engine."""
    ended_well(AS_ON_WINDOWS + IMPORT_ALL, tmp_path)


@pytest.mark.slow
def test_torcslite_is_driven_learned_and_reported_where_there_is_no_posix(tmp_path):
    out = ended_well(AS_ON_WINDOWS + TRAINING + VERBS, tmp_path)
    assert "ok       TorcsLite-v0 " in out
    written = {path.name for path in tmp_path.iterdir()}
    assert {"a.parquet", "a.html", "a.png", "board", "model.zip"} <= written


@pytest.mark.slow
def test_a_training_runs_where_there_is_no_posix(tmp_path):
    words = "train --algo ppo --env TorcsLite-v0 --timesteps 256 --eval-freq 0 --no-progress"
    words = [*words.split(), "--hyperparams", "n_steps=32"]
    status, out, err = python(AS_ON_WINDOWS + MAIN, tmp_path, *words)
    assert status == 0, err
    assert "learned from" in out


@pytest.mark.rare
def test_an_agent_competes_over_the_network_where_there_is_no_posix(tmp_path):
    """A server that is not there ends it with a line."""
    words = ["compete", "ppo-aalborg", "--port", "2", "--json"]
    status, _, err = python(AS_ON_WINDOWS + MAIN, tmp_path, *words)
    assert status == 2, err
    assert "SCR server" in err.splitlines()[-1]
