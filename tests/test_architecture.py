"""The arrows of the house point downward; nothing reaches for what it must not."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parent.parent / "sb3_torcs"
FILES = sorted(PACKAGE.rglob("*.py"))

MAX_CODE_LINES = 300
LONGER_FILES = {
    "backends/lite_physics.py": 320,  # one physics step is one piece
}

# Lower floors know nothing of higher ones. A name stands for the module or the folder.
FLOORS = (
    {"errors", "car", "building"},
    {
        "game", "tracks", "torcs_params", "track_file", "track_xml", "track_pits", "track_random",
        "track_plot", "track_trial", "track_trial_child",
        "race_file", "race_results", "game_process", "game_results", "game_window",
        "game_scenery", "display",
    },
    {"sensors", "actions", "rewards", "scr_protocol"},
    {"scr_client", "scr_game"},
    {"backends"},
    {"highway", "scenery", "hud", "rendering", "video", "film", "game_view"},
    {"envs"},
)  # fmt: skip
VOCABULARY = {"car", "tracks", "sensors", "actions", "rewards", "scr_protocol"}
STEP_AND_RESET = VOCABULARY | {"backends", "envs", "track_random"}
LEARNING = {
    "policies", "networks", "optimizers", "fast_matmul", "noise", "callbacks", "driving_metrics",
    "mirror", "progress", "export", "keeping",
}  # fmt: skip
GRAPHICS = {"highway", "scenery", "hud", "rendering", "film", "game_view", "watching"}
STARTS_PROGRAMS = {"game_process.py", "display.py", "text_mode.py", "cli/install_torcs.py"}
TRIES_TRACKS = "track_trial.py"  # in a process of its own, since a broken one may crash it
LOADS_THE_ENGINE = {"backends/native.py", "track_trial_child.py"}
HAS_THE_GAME_RUN = {  # and nothing else: no world but one needs another process
    "backends/scr.py", "scr_game.py", "game_window.py", "game_results.py", "text_mode.py",
    "film.py", "game_view.py", "watching.py",
}  # fmt: skip


class Import(NamedTuple):
    """A name that a file imports, e.g. ``sb3_torcs.backends.base``."""

    name: str
    lazy: bool  # inside a function

    def within(self, package: str) -> bool:
        """Whether it is this package or something in it."""
        return self.name == package or self.name.startswith(f"{package}.")


def imports_of(source: str) -> list[Import]:
    """All imports of a file but those for type checkers only; ``from a import b`` gives ``a.b``."""
    return list(_walk(ast.parse(source), lazy=False))


def _walk(node: ast.AST, lazy: bool) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from (Import(alias.name, lazy) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "relative imports hide where an arrow points"
            yield from (Import(f"{child.module}.{alias.name}", lazy) for alias in child.names)
        elif isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        else:
            function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            yield from _walk(child, lazy or function)


def unit(path: Path) -> str:
    """The module's name, or that of its folder."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def source(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def of(units: set[str]) -> list[Path]:
    """The files of some modules and folders."""
    missing = units - {unit(path) for path in FILES}
    assert not missing, f"{missing} is gone: this test guards nothing there"
    return [path for path in FILES if unit(path) in units]


def named(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


def forbidden(path: Path, packages: set[str], lazy_too: bool = True) -> list[str]:
    """What a file imports of what it must not."""
    return [
        found.name
        for found in imports_of(source(path))
        for package in packages
        if found.within(package) and (lazy_too or not found.lazy)
    ]


def test_the_walk_sees_lazy_imports_and_skips_those_for_types():
    code = (
        "import a.b\nif TYPE_CHECKING:\n    import c\n"
        "def f():\n    from d import e\nclass G:\n    import h\n"
    )
    assert imports_of(code) == [Import("a.b", False), Import("d.e", True), Import("h", False)]
    assert Import("a.b", False).within("a")
    assert not Import("ab", False).within("a")


@pytest.mark.parametrize("path", of(VOCABULARY), ids=named)
def test_the_vocabulary_is_pure(path):
    """It has to work where there is no environment, no network and no simulator."""
    packages = {"gymnasium", "socket", "torch", "stable_baselines3", "sb3_torcs.backends"}
    assert forbidden(path, packages | {"sb3_torcs.envs"}) == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_one_file_knows_the_cluster(path):
    """And imports it only when a study is run: nothing else needs Ray."""
    assert forbidden(path, {"ray"}, lazy_too=named(path) != "study.py") == []


@pytest.mark.parametrize("path", of({"backends"}), ids=named)
def test_worlds_know_nothing_of_agents(path):
    assert forbidden(path, {"gymnasium", "torch", "stable_baselines3", "rl_zoo3"}) == []


@pytest.mark.parametrize("path", of({"envs"}), ids=named)
def test_environments_know_nothing_of_learning(path):
    assert forbidden(path, {"torch", "stable_baselines3", "rl_zoo3"}) == []


def test_the_loop_names_no_world():
    path = PACKAGE / "envs" / "racing.py"
    worlds = forbidden(path, {"sb3_torcs.backends"})
    assert worlds == ["sb3_torcs.backends.base.Backend"]


@pytest.mark.parametrize("path", of(LEARNING), ids=named)
def test_what_learns_never_imports_a_world(path):
    """So that it works with the next one, too."""
    assert forbidden(path, {"sb3_torcs.backends", "sb3_torcs.envs"}) == []


@pytest.mark.parametrize("path", of(set().union(*FLOORS)), ids=named)
def test_arrows_point_downward(path):
    """Modules import from their own floor or a lower one when they are loaded."""
    (floor,) = [number for number, units in enumerate(FLOORS) if unit(path) in units]
    below = set().union(*FLOORS[: floor + 1])
    # The package itself registers the environments and loads nothing.
    own = [found for found in imports_of(source(path)) if found.name.startswith("sb3_torcs.")]
    upward = [f.name for f in own if not f.lazy and f.name.split(".")[1] not in below]
    assert upward == []


@pytest.mark.parametrize("path", [path for path in FILES if unit(path) not in GRAPHICS], ids=named)
def test_graphics_load_only_when_somebody_looks(path):
    packages = {f"sb3_torcs.{name}" for name in GRAPHICS}
    packages |= {"highway_env", "pygame", "matplotlib"}
    assert forbidden(path, packages, lazy_too=False) == []


@pytest.mark.parametrize("path", of(STEP_AND_RESET), ids=named)
def test_no_clock_stands_in_the_way_of_a_step(path):
    """Time is counted in physics steps: a busy machine must not change what happens."""
    assert forbidden(path, {"time", "datetime", "timeit"}) == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_no_shell_and_no_other_process(path):
    # To ask ffmpeg whether a film is whole, and to try a kernel that may kill the process.
    allowed = STARTS_PROGRAMS | {TRIES_TRACKS, "video.py", "fast_matmul.py"}
    processes = set() if named(path) in allowed else {"subprocess"}
    assert forbidden(path, processes | {"pty", "pexpect", "os.system", "os.popen"}) == []
    text = source(path)
    for word in ("os.system", "os.popen", "os.exec", "os.spawn", "pkill", "killall", "shell=True"):
        assert word not in text


@pytest.mark.parametrize("path", [p for p in FILES if unit(p) != "cli"], ids=named)
def test_few_have_programs_run(path):
    starters = {f"sb3_torcs.{name[:-3].replace('/', '.')}" for name in STARTS_PROGRAMS}
    assert named(path) in HAS_THE_GAME_RUN or forbidden(path, starters) == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_few_speak_over_a_network(path):
    speakers = {"scr_client.py", "scr_game.py", "display.py", "game_view.py"}
    assert named(path) in speakers or forbidden(path, {"socket"}) == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_one_file_knows_the_engine(path):
    """
    All others go through it, so that there is one place that says how to build it; but for the
    process that tries a track, which starts faster so.
    """
    found = forbidden(path, {"sb3_torcs._engine"})
    assert found == (["sb3_torcs._engine"] if named(path) in LOADS_THE_ENGINE else [])


def test_the_engine_loads_only_when_somebody_drives():
    path = PACKAGE / "backends" / "native.py"
    assert forbidden(path, {"sb3_torcs._engine"}, lazy_too=False) == []


@pytest.mark.parametrize("path", of({"robots", "race_results"}), ids=named)
def test_robots_need_no_agent(path):
    packages = {"gymnasium", "torch", "stable_baselines3", "rl_zoo3", "sb3_torcs.envs"}
    assert forbidden(path, packages) == []


NATIVE = sorted(path for path in (PACKAGE / "native").rglob("*") if path.is_file())


@pytest.mark.parametrize("path", NATIVE, ids=lambda p: p.name)
def test_one_file_knows_python(path):
    """The engine could be used from C++."""
    text = source(path)
    assert ("pybind11" in text) == (path.name == "bindings.cpp")
    assert "Python.h" not in text


ALLOWED_OF_RANDOM = {"Generator", "default_rng", "SeedSequence", "PCG64", "BitGenerator"}


@pytest.mark.parametrize("path", FILES, ids=named)
def test_no_global_random_state(path):
    """A generator is handed in or seeded; what others draw elsewhere changes nothing."""
    assert forbidden(path, {"random", "numpy.random"}) == []
    used = {
        node.attr
        for node in ast.walk(ast.parse(source(path)))
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("np.random", "th.random")
    }
    assert used <= ALLOWED_OF_RANDOM


def code_lines(text: str) -> int:
    """Lines that hold code: no blank ones, comments or docstrings."""
    silent = {
        tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
        tokenize.ENDMARKER,
    }  # fmt: skip
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in silent:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_text and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, node.end_lineno + 1))
    return len(lines)


def test_code_lines_are_those_that_do_something():
    assert code_lines('"""Doc."""\n\n# comment\nx = (\n    1  # one\n)\n') == 3


@pytest.mark.parametrize("path", FILES, ids=named)
def test_no_file_is_longer_than_one_can_read(path):
    assert code_lines(source(path)) <= LONGER_FILES.get(named(path), MAX_CODE_LINES)


def test_the_list_of_longer_files_is_not_longer_than_needed():
    needed = {named(path) for path in FILES if code_lines(source(path)) > MAX_CODE_LINES}
    assert set(LONGER_FILES) == needed
