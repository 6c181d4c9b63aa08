"""Each room stands on one floor and imports from lower floors only.

A room is a module or a folder at the top of the package.
"""

from __future__ import annotations

import ast
import configparser
import fnmatch
import importlib
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parent.parent / "sb3_torcs"
FILES = sorted(PACKAGE.rglob("*.py"))

OLDER_PLACES = {PACKAGE / name for name in ("agents/model_writing.py", "progress.py", "zoo.py")}

MAX_MODULES = 16  # at the top of the package
MAX_FOLDERS = 17  # of Python there; beside them native/, the C++
MAX_CODE_LINES = 300
LONGER_FILES = {
    "backends/lite/physics.py": 320,  # one physics step is one piece
}

# From the ground up. `sb3_torcs/__init__.py` registers the environments and loads nothing.
FLOORS = (
    {"_engine", "cores", "errors", "maths", "signals"},
    {"car", "files"},
    {"torcs"},
    {"rivals", "tracks"},
    {"actions", "rewards", "sensors"},  # with car and tracks: the vocabulary
    {"noise", "policies", "rendering", "scr", "telemetry"},
    {"backends"},
    {"envs"},
    {"agents", "vec_env"},
    {"callbacks", "evaluation", "races"},
    {"training"},
    {"bench", "studies"},
    {"cli", "progress", "rl_zoo", "zoo"},
)
VOCABULARY = {"actions", "car", "rewards", "rivals", "sensors"}
PURE_FILES = ("tracks/track.py", "tracks/generator.py", "scr/protocol.py")
STEP_AND_RESET = VOCABULARY | {"backends", "envs", "tracks"}
LEARNING = {"callbacks", "noise", "policies"}

DRAWS = {
    "evaluation/watching.py", "rendering/board.py", "rendering/game_camera.py",
    "rendering/game_video.py", "rendering/gap.py", "rendering/highway.py", "rendering/hud.py",
    "rendering/scenery.py", "rendering/viewer.py",
}  # fmt: skip
STARTS_PROGRAMS = {
    "torcs/display.py",
    "torcs/libraries.py",
    "torcs/packages.py",
    "torcs/process.py",
}
STARTS_A_CHILD = {
    "rendering/encoder.py",  # to ask ffmpeg whether a video is whole
    "tracks/trial.py",  # to load a track that may crash the game's loader
}
HAS_THE_GAME_RUN = {  # and nothing else: no world but one needs another process
    "races/text_mode.py", "backends/scr.py", "evaluation/watching.py",
    "rendering/game_camera.py", "rendering/game_video.py", "scr/server.py", "torcs/libraries.py",
    "torcs/packages.py", "torcs/results.py", "torcs/window.py",
}  # fmt: skip
USES_A_NETWORK = {"rendering/game_camera.py", "scr/client.py", "scr/server.py", "torcs/display.py"}
LOADS_THE_ENGINE = {"backends/native.py", "torcs/trial_child.py"}
ASKS_DRIVERS = {
    "agents/saved/driver.py",  # hands on what it is asked
    "agents/pilots.py",  # several at once, in one race
    "agents/rollout.py",
    "bench/drives.py",  # on threads, where nobody looks at what is driven
    "callbacks/driven_line.py",  # hands on, for all cars of a vector
    "training/keeping.py",  # only to see whether the answer is a number
}


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


def room(path: Path) -> str:
    """The module at the package's top, or the folder there that the file is in."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def source(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def files_of(rooms: set[str]) -> list[Path]:
    missing = rooms - {room(path) for path in FILES}
    assert not missing, f"{missing} is gone: this test guards nothing there"
    return [path for path in FILES if room(path) in rooms]


def pure_files() -> list[Path]:
    return [*files_of(VOCABULARY), *(PACKAGE / name for name in PURE_FILES)]


def on_the_way_of_a_step() -> list[Path]:
    return files_of(STEP_AND_RESET)


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


def floor_of(name: str) -> int:
    (floor,) = [number for number, rooms in enumerate(FLOORS) if name in rooms]
    return floor


def rooms_that(path: Path) -> set[str]:
    """The other rooms that a file imports from, inside functions too."""
    own = [found.name.split(".") for found in imports_of(source(path))]
    return {name[1] for name in own if name[0] == "sb3_torcs" and len(name) > 1} - {
        room(path), "__version__",
    }  # fmt: skip


def upward(path: Path) -> list[str]:
    """The rooms on a file's own floor or above it from which it imports."""
    return sorted(name for name in rooms_that(path) if floor_of(name) >= floor_of(room(path)))


def in_circle(graph: dict[str, set[str]]) -> list[str]:
    """The nodes from which a walk along the arrows comes back."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        open_nodes = [start]
        while open_nodes:
            for node in graph.get(open_nodes.pop(), ()):
                if node not in seen:
                    seen.add(node)
                    open_nodes.append(node)
        return seen

    return sorted(node for node in graph if node in reached(node))


def modules_that(path: Path, modules: set[str]) -> set[str]:
    """The modules of the package that a file imports, by their dotted names."""
    found = {item.name for item in imports_of(source(path))}
    return {name for name in modules if name in found or any(
        item.rpartition(".")[0] == name for item in found)}  # fmt: skip


def test_the_walk_sees_lazy_imports_and_skips_those_for_types():
    code = (
        "import a.b\nif TYPE_CHECKING:\n    import c\n"
        "def f():\n    from d import e\nclass G:\n    import h\n"
    )
    assert imports_of(code) == [Import("a.b", False), Import("d.e", True), Import("h", False)]
    assert Import("a.b", False).within("a")
    assert not Import("ab", False).within("a")


def test_a_circle_is_found():
    assert in_circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == ["a", "b", "c"]


def floor_plan() -> dict[str, str]:
    """What docs/architecture.md says of each room."""
    block = (PACKAGE.parent / "docs/architecture.md").read_text("utf-8").split("```")[1]
    return {
        text.split()[0].rstrip("/"): text
        for text in re.split(r"\n {2}(?=\w)", block)
        if text.strip()
    }


def test_every_module_stands_in_the_floor_plan():
    plan = floor_plan()
    for path in FILES:
        if path in OLDER_PLACES or path.stem.startswith("__"):
            continue
        if path.parent != PACKAGE and room(path) != "cli":
            words = re.findall(r"[\w*]+", plan[room(path)])
            assert any(fnmatch.fnmatch(path.stem, word) for word in words), path
    rooms = {room(path) for path in FILES if path not in OLDER_PLACES} - {"__init__"}
    assert set(plan) == rooms


def test_each_room_stands_on_one_floor():
    """A new module or folder needs a floor: add it to FLOORS, above all that it imports."""
    rooms = {room(path) for path in FILES if named(path) != "__init__.py"} | {"_engine"}
    placed = [name for floor in FLOORS for name in floor]
    assert sorted(placed) == sorted(rooms)


@pytest.mark.parametrize("path", [p for p in FILES if named(p) != "__init__.py"], ids=named)
def test_arrows_point_downward(path):
    """No room imports from its own floor or a higher one, inside functions either."""
    assert upward(path) == []


def test_no_files_import_each_other():
    dotted = {f"sb3_torcs.{named(p).removesuffix('.py').replace('/', '.')}": p for p in FILES}
    graph = {name: modules_that(path, set(dotted)) for name, path in dotted.items()}
    assert in_circle(graph) == []


def test_each_folder_of_python_is_installed():
    """A folder that setup.cfg does not name is missing from the wheel."""
    setup = configparser.ConfigParser()
    setup.read(PACKAGE.parent / "setup.cfg")
    listed = set(setup["options"]["packages"].split())
    folders = {".".join(path.parent.relative_to(PACKAGE.parent).parts) for path in FILES}
    assert listed == folders | {"sb3_torcs.zoo_configs"}


@pytest.mark.parametrize("path", [
    "sb3_torcs.callbacks.GradientStepsCallback", "sb3_torcs.callbacks.MirrorCallback",
    "sb3_torcs.callbacks.NoiseCallback", "sb3_torcs.callbacks.NoiseDecayCallback",
    "sb3_torcs.callbacks.DrivingMetricsCallback", "sb3_torcs.callbacks.RandomStartCallback",
    "sb3_torcs.callbacks.RewardCallback", "sb3_torcs.callbacks.StochasticBrakeCallback",
    "sb3_torcs.noise.OUNoise", "sb3_torcs.noise.SetPointNoise",
    "sb3_torcs.policies.SplitHeadPolicy", "sb3_torcs.policies.export_actor",
    "sb3_torcs.agents.model_writing.RecordCallback", "sb3_torcs.callbacks.RecordCallback",
    "sb3_torcs.agents.model_writing.write_driver",
    "sb3_torcs.progress.RacingProgressCallback", "sb3_torcs.zoo.UninterruptedWorker",
    "sb3_torcs.tracks.load_track", "sb3_torcs.evaluation.evaluate",
])  # fmt: skip
def test_what_files_and_people_name_stays_importable(path):
    """Saved models, records of trainings and hyperparameter files hold these names."""
    module, _, name = path.rpartition(".")
    assert hasattr(importlib.import_module(module), name)


def exported(path: Path) -> set[str] | None:
    """The names in ``__all__``, if there is one."""
    for node in ast.parse(source(path)).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return None


@pytest.mark.parametrize("path", FILES, ids=str)
def test_what_other_files_use_is_exported(path):
    for node in ast.walk(ast.parse(source(path))):
        module = getattr(node, "module", None) or ""
        if not isinstance(node, ast.ImportFrom) or not module.startswith("sb3_torcs."):
            continue
        whence = PACKAGE.parent.joinpath(*module.split("."))
        offered = (
            exported(whence.with_suffix(".py")) if whence.with_suffix(".py").is_file() else None
        )
        if offered is not None:
            assert {alias.name for alias in node.names} <= offered, module


TESTS = sorted(Path(__file__).parent.glob("*.py"))
RUNS_TEXT = {"test_docs.py"}  # the snippets of the docs


def faults_of_a_test(text: str) -> list[str]:
    """
    What hides that something is missing, what nobody finds, and what no linter reads.

    Code for another process counts: it imports from the helpers beside the tests, too.
    """
    called = {
        ast.unparse(node.func).rpartition(".")[2]
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
    }
    imported = set(re.findall(r"\b(?:from|import) (test_\w+)", text))
    return sorted((called & {"importorskip", "exec"}) | imported)


def test_the_faults_of_a_test_are_found():
    bad = "from test_a import b\nrun('import test_c')\npytest.importorskip('d')\nexec('e')\n"
    assert faults_of_a_test(bad) == ["exec", "importorskip", "test_a", "test_c"]


@pytest.mark.parametrize("path", TESTS, ids=lambda path: path.name)
def test_tests_skip_nothing_and_share_helpers(path):
    """What several tests need stands in a module of its own."""
    if path.name == Path(__file__).name:
        return
    allowed = ["exec"] if path.name in RUNS_TEXT else []
    assert faults_of_a_test(source(path)) == allowed


def test_the_top_of_the_package_is_short():
    modules = [path for path in PACKAGE.glob("*.py*") if path.suffix in (".py", ".pyi")]
    folders = [path for path in PACKAGE.iterdir() if any(path.glob("*.py"))]
    assert len(modules) <= MAX_MODULES
    assert len(folders) <= MAX_FOLDERS


@pytest.mark.parametrize("path", pure_files(), ids=named)
def test_the_vocabulary_is_pure(path):
    """It has to work where there is no environment, no network and no simulator."""
    packages = {"gymnasium", "socket", "torch", "stable_baselines3", "sb3_torcs.backends"}
    assert forbidden(path, packages | {"sb3_torcs.envs"}) == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_one_file_knows_the_cluster(path):
    """And imports it only when a study is run: nothing else needs Ray."""
    assert forbidden(path, {"ray"}, lazy_too=named(path) != "studies/runner.py") == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_one_file_starts_the_zoo(path):
    zoo = {"rl_zoo3.train", "rl_zoo3.exp_manager"}
    assert named(path) == "training/manager.py" or forbidden(path, zoo) == []


@pytest.mark.parametrize("path", files_of({"backends"}), ids=named)
def test_worlds_know_nothing_of_agents(path):
    assert forbidden(path, {"gymnasium", "torch", "stable_baselines3", "rl_zoo3"}) == []


@pytest.mark.parametrize("path", files_of({"backends"}), ids=named)
def test_a_world_knows_no_other_world(path):
    """What two of them need stands below both."""
    own = path.relative_to(PACKAGE / "backends").parts[0].removesuffix(".py")
    siblings = {
        f"sb3_torcs.backends.{world}" for world in ("lite", "native", "scr") if world != own
    }
    assert forbidden(path, siblings) == []


@pytest.mark.parametrize("path", files_of({"envs"}), ids=named)
def test_environments_know_nothing_of_learning(path):
    assert forbidden(path, {"torch", "stable_baselines3", "rl_zoo3"}) == []


def test_the_loop_names_no_world():
    path = PACKAGE / "envs" / "racing.py"
    worlds = forbidden(path, {"sb3_torcs.backends"})
    assert set(worlds) == {"sb3_torcs.backends.base.Backend", "sb3_torcs.backends.base.optional"}


@pytest.mark.parametrize("path", files_of(LEARNING), ids=named)
def test_what_learns_never_imports_a_world(path):
    """So that it works with the next one, too."""
    assert forbidden(path, {"sb3_torcs.backends", "sb3_torcs.envs"}) == []


@pytest.mark.parametrize("path", [p for p in FILES if named(p) not in DRAWS], ids=named)
def test_graphics_load_only_when_somebody_looks(path):
    packages = {f"sb3_torcs.{name[:-3].replace('/', '.')}" for name in DRAWS}
    packages |= {"highway_env", "pygame", "matplotlib"}
    assert forbidden(path, packages, lazy_too=False) == []


@pytest.mark.parametrize("path", on_the_way_of_a_step(), ids=named)
def test_no_clock_stands_in_the_way_of_a_step(path):
    """Time is counted in physics steps: a busy machine must not change what happens."""
    assert forbidden(path, {"time", "datetime", "timeit"}) == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_no_shell_and_no_other_process(path):
    allowed = STARTS_PROGRAMS | STARTS_A_CHILD
    processes = set() if named(path) in allowed else {"subprocess"}
    assert forbidden(path, processes | {"pty", "pexpect", "os.system", "os.popen"}) == []
    text = source(path)
    for word in ("os.system", "os.popen", "os.exec", "os.spawn", "pkill", "killall", "shell=True"):
        assert word not in text


@pytest.mark.parametrize("path", [p for p in FILES if room(p) != "cli"], ids=named)
def test_few_have_programs_run(path):
    starters = {f"sb3_torcs.{name[:-3].replace('/', '.')}" for name in STARTS_PROGRAMS}
    assert named(path) in HAS_THE_GAME_RUN or forbidden(path, starters) == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_few_speak_over_a_network(path):
    assert named(path) in USES_A_NETWORK or forbidden(path, {"socket"}) == []


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


@pytest.mark.parametrize("path", FILES, ids=named)
def test_one_file_knows_xml(path):
    """What of TORCS is read and written, is so in one way."""
    assert named(path) == "torcs/params.py" or forbidden(path, {"xml"}) == []


def test_the_car_and_its_gearbox_are_said_once():
    """Name, length, width, lock, limiter and shift points; the engine's C++ says them once more."""
    wanted = ["car1-trb1", 4.52, 1.94, 21.0, 9152.0, 8500.0, 7500.0]
    said = [
        node.value
        for path in FILES
        for node in ast.walk(ast.parse(source(path)))
        if isinstance(node, ast.Constant) and type(node.value) in (str, float)
    ]
    assert {value: said.count(value) for value in wanted} == dict.fromkeys(wanted, 1)


@pytest.mark.parametrize("path", FILES, ids=named)
def test_one_file_lets_drivers_drive(path):
    """So that a lap is the same lap, whoever asks for it."""
    called = {node.func.attr for node in ast.walk(ast.parse(source(path)))
              if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)}  # fmt: skip
    assert ("predict" in called) == (named(path) in ASKS_DRIVERS)


@pytest.mark.parametrize("name", ["agents/robots.py", "torcs/race_results.py"])
def test_robots_need_no_agent(name):
    packages = {"gymnasium", "torch", "stable_baselines3", "rl_zoo3", "sb3_torcs.envs"}
    assert forbidden(PACKAGE / name, packages) == []


NATIVE = sorted(path for path in (PACKAGE / "native").rglob("*") if path.is_file())


@pytest.mark.parametrize("path", NATIVE, ids=lambda p: p.name)
def test_one_file_knows_python(path):
    """The engine could be used from C++."""
    text = source(path)
    assert ("pybind11" in text) == (path.name == "bindings.cpp")
    assert "Python.h" not in text


DRAWS_AS_SB3 = "policies/mirrored_replay.py"  # the numbers that SB3's buffers would draw
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
    own = {"randint"} if named(path) == DRAWS_AS_SB3 else set()
    assert used <= ALLOWED_OF_RANDOM | own


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
