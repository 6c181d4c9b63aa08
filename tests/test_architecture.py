"""Each room stands on one floor and imports from lower floors only.

A room is a module or a folder at the top of the package.
"""

from __future__ import annotations

import ast
import configparser
import fnmatch
import functools
import importlib
import io
import re
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from lint import assert_none, nodes, source, tree

PACKAGE = Path(__file__).parent.parent / "sb3_torcs"
FILES = sorted(PACKAGE.rglob("*.py"))

MAX_MODULES = 16  # at the top of the package
MAX_FOLDERS = 17  # of Python there; beside them native/, the C++
MAX_CODE_LINES = 300
LONGER_FILES = {"backends/lite/physics.py": 320}  # one physics step is one piece

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
    {"cli", "rl_zoo"},
)
VOCABULARY = {"actions", "car", "rewards", "rivals", "sensors"}
PURE_FILES = ("tracks/track.py", "tracks/generator.py", "scr/protocol.py")
STEP_AND_RESET = VOCABULARY | {"backends", "envs", "tracks"}
LEARNING = {"callbacks", "noise", "policies"}

DRAWS = {
    "rendering/board.py", "rendering/game_camera.py", "rendering/gap.py", "rendering/highway.py",
    "rendering/hud.py", "rendering/scenery.py", "rendering/viewer.py",
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
    "backends/scr.py", "evaluation/watching.py", "rendering/game_camera.py", "scr/server.py",
    "torcs/libraries.py", "torcs/packages.py", "torcs/results.py", "torcs/window.py",
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
    line: int

    def within(self, package: str) -> bool:
        """Whether it is this package or something in it."""
        return self.name == package or self.name.startswith(f"{package}.")


@functools.cache
def imports_of(path: Path) -> list[Import]:
    """All imports of a file but those for type checkers only; ``from a import b`` gives ``a.b``."""
    return list(_walk(tree(path), lazy=False))


def _walk(node: ast.AST, lazy: bool) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from (Import(alias.name, lazy, child.lineno) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "relative imports hide where an arrow points"
            for alias in child.names:
                yield Import(f"{child.module}.{alias.name}", lazy, child.lineno)
        elif isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        else:
            function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            yield from _walk(child, lazy or function)


def room(path: Path) -> str:
    """The module at the package's top, or the folder there that the file is in."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


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


def all_but(allowed: set[str]) -> list[Path]:
    missing = allowed - {named(path) for path in FILES}
    assert not missing, f"{missing} is gone: the rule needs no such exception"
    return [path for path in FILES if named(path) not in allowed]


def modules(names: set[str]) -> set[str]:
    """The dotted names of files of the package."""
    return {f"sb3_torcs.{name.removesuffix('.py').replace('/', '.')}" for name in names}


def forbidden(paths: Iterable[Path], packages: set[str], lazy_too: bool = True) -> list[str]:
    """Where files import what they must not."""
    return [
        f"{named(path)}:{found.line}: imports {found.name}"
        for path in paths
        for found in imports_of(path)
        if any(found.within(package) for package in packages) and (lazy_too or not found.lazy)
    ]


def floor_of(name: str) -> int:
    (floor,) = [number for number, rooms in enumerate(FLOORS) if name in rooms]
    return floor


def upward(path: Path) -> Iterator[str]:
    """Where a file imports from its own floor or above it, but for its own room."""
    for found in imports_of(path):
        package, _, rest = found.name.partition(".")
        other = rest.partition(".")[0]
        if package != "sb3_torcs" or other in ("", room(path), "__version__"):
            continue
        if floor_of(other) >= floor_of(room(path)):
            yield f"{named(path)}:{found.line}: imports {found.name}"


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
    found = {item.name for item in imports_of(path)}
    return {name for name in modules if name in found or any(
        item.rpartition(".")[0] == name for item in found)}  # fmt: skip


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
        if path.stem.startswith("__"):
            continue
        if path.parent != PACKAGE and room(path) != "cli":
            words = re.findall(r"[\w*]+", plan[room(path)])
            assert any(fnmatch.fnmatch(path.stem, word) for word in words), path
    rooms = {room(path) for path in FILES} - {"__init__"}
    assert set(plan) == rooms


def test_each_room_stands_on_one_floor():
    """A new module or folder needs a floor: add it to FLOORS, above all that it imports."""
    rooms = {room(path) for path in FILES if named(path) != "__init__.py"} | {"_engine"}
    placed = [name for floor in FLOORS for name in floor]
    assert sorted(placed) == sorted(rooms)


def test_arrows_point_downward():
    """No room imports from its own floor or a higher one, inside functions either."""
    assert_none(fault for path in all_but({"__init__.py"}) for fault in upward(path))


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
    "sb3_torcs.callbacks.replay.GradientStepsCallback",
    "sb3_torcs.callbacks.replay.MirrorCallback", "sb3_torcs.training.schedules.FallingSchedule",
    "sb3_torcs.callbacks.NoiseCallback", "sb3_torcs.callbacks.NoiseDecayCallback",
    "sb3_torcs.callbacks.DrivingMetricsCallback", "sb3_torcs.callbacks.RandomStartCallback",
    "sb3_torcs.callbacks.RewardCallback", "sb3_torcs.callbacks.StochasticBrakeCallback",
    "sb3_torcs.noise.OUNoise", "sb3_torcs.noise.SetPointNoise",
    "sb3_torcs.policies.SplitHeadPolicy", "sb3_torcs.policies.export_actor",
    "sb3_torcs.callbacks.RecordCallback",
    "sb3_torcs.tracks.load_track", "sb3_torcs.evaluation.evaluate",
])  # fmt: skip
def test_what_files_and_people_name_stays_importable(path):
    """Saved models, records of trainings and hyperparameter files hold these names."""
    module, _, name = path.rpartition(".")
    assert hasattr(importlib.import_module(module), name)


@functools.cache
def exported(path: Path) -> set[str] | None:
    """The names in ``__all__``, if there is one."""
    for node in tree(path).body if path.is_file() else ():
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return None


def unexported(path: Path) -> Iterator[str]:
    for node in nodes(path):
        if not isinstance(node, ast.ImportFrom) or not str(node.module).startswith("sb3_torcs."):
            continue
        offered = exported(PACKAGE.parent.joinpath(*node.module.split(".")).with_suffix(".py"))
        hidden = {alias.name for alias in node.names} - (offered or set())
        if offered is not None and hidden:
            yield f"{named(path)}:{node.lineno}: {node.module} does not export {hidden}"


def test_what_other_files_use_is_exported():
    assert_none(fault for path in FILES for fault in unexported(path))


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


def test_tests_skip_nothing_and_share_helpers():
    """What several tests need stands in a module of its own."""
    found = {path.name: faults_of_a_test(source(path)) for path in TESTS if path != Path(__file__)}
    faults = {name: words for name, words in found.items() if words}
    assert faults == {name: ["exec"] for name in RUNS_TEXT}


def test_the_top_of_the_package_is_short():
    modules = [path for path in PACKAGE.glob("*.py*") if path.suffix in (".py", ".pyi")]
    folders = [path for path in PACKAGE.iterdir() if any(path.glob("*.py"))]
    assert len(modules) <= MAX_MODULES
    assert len(folders) <= MAX_FOLDERS


def robots() -> list[Path]:
    return [PACKAGE / name for name in ("agents/robots.py", "torcs/race_results.py")]


def others_than_commands() -> list[Path]:
    return [path for path in all_but(HAS_THE_GAME_RUN) if room(path) != "cli"]


AGENTS = {"gymnasium", "torch", "stable_baselines3", "rl_zoo3"}
LEARNING_LIBRARIES = AGENTS - {"gymnasium"}
WORLDS = {"sb3_torcs.backends", "sb3_torcs.envs"}
SIMULATOR = {"gymnasium", "socket", "torch", "stable_baselines3", *WORLDS}
GRAPHICS = modules(DRAWS) | {"highway_env", "pygame", "matplotlib"}
ENGINE = {"sb3_torcs._engine"}
NEVER = {  # files that import none of the packages, inside functions either
    "the vocabulary is pure": (pure_files, SIMULATOR),
    "one file knows the cluster": (lambda: all_but({"studies/runner.py"}), {"ray"}),
    "no file needs the zoo": (lambda: FILES, {"rl_zoo3"}),
    "worlds know nothing of agents": (lambda: files_of({"backends"}), AGENTS),
    "environments know nothing of learning": (lambda: files_of({"envs"}), LEARNING_LIBRARIES),
    "what learns works with the next world, too": (lambda: files_of(LEARNING), WORLDS),
    "a busy machine changes no step": (on_the_way_of_a_step, {"time", "datetime", "timeit"}),
    "few have programs run": (others_than_commands, modules(STARTS_PROGRAMS)),
    "few speak over a network": (lambda: all_but(USES_A_NETWORK), {"socket"}),
    "one file says how to build the engine": (lambda: all_but(LOADS_THE_ENGINE), ENGINE),
    "two files know XML": (lambda: all_but({"torcs/params.py", "torcs/nodes.py"}), {"xml"}),
    "robots need no agent": (robots, AGENTS | {"sb3_torcs.envs"}),
}
ONLY_IN_FUNCTIONS = {  # packages that files load when somebody needs them
    "Ray, for a study": (lambda: FILES, {"ray"}),
    "graphics, for who looks": (lambda: all_but(DRAWS), GRAPHICS),
    "the engine, for who drives": (lambda: [PACKAGE / "backends" / "native.py"], ENGINE),
}


@pytest.mark.parametrize("rule", NEVER)
def test_files_do_not_import(rule):
    files, packages = NEVER[rule]
    assert_none(forbidden(files(), packages))


@pytest.mark.parametrize("rule", ONLY_IN_FUNCTIONS)
def test_files_import_only_in_functions(rule):
    files, packages = ONLY_IN_FUNCTIONS[rule]
    assert_none(forbidden(files(), packages, lazy_too=False))


@pytest.mark.parametrize("world", ["lite", "native", "scr"])
def test_a_world_knows_no_other_world(world):
    """What two of them need stands below both."""
    others = [
        path
        for path in files_of({"backends"})
        if path.relative_to(PACKAGE / "backends").parts[0].removesuffix(".py") != world
    ]
    assert_none(forbidden(others, {f"sb3_torcs.backends.{world}"}))


def test_the_loop_names_no_world():
    found = forbidden([PACKAGE / "envs" / "racing.py"], {"sb3_torcs.backends"})
    assert {fault.rpartition(".")[2] for fault in found} == {"Backend", "optional"}


def test_no_shell_and_no_other_process():
    assert_none(forbidden(all_but(STARTS_PROGRAMS | STARTS_A_CHILD), {"subprocess"}))
    assert_none(forbidden(FILES, {"pty", "pexpect", "os.system", "os.popen"}))
    words = r"os\.(system|popen|exec|spawn)|pkill|killall|shell=True"
    assert [named(path) for path in FILES if re.search(words, source(path))] == []


def test_the_car_and_its_gearbox_are_said_once():
    """Name, length, width, lock, limiter and shift points; the engine's C++ says them once more."""
    wanted = ["car1-trb1", 4.52, 1.94, 21.0, 9152.0, 8500.0, 7500.0]
    said = [
        node.value
        for path in FILES
        for node in nodes(path)
        if isinstance(node, ast.Constant) and type(node.value) in (str, float)
    ]
    assert {value: said.count(value) for value in wanted} == dict.fromkeys(wanted, 1)


def asks_a_driver(node: ast.AST) -> bool:
    call = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    return call and node.func.attr == "predict"


def test_few_files_let_drivers_drive():
    """So that a lap is the same lap, whoever asks for it."""
    asking = {named(path) for path in FILES if any(map(asks_a_driver, nodes(path)))}
    assert asking == ASKS_DRIVERS


def test_one_file_knows_python():
    """The engine could be used from C++."""
    native = sorted(path for path in (PACKAGE / "native").rglob("*") if path.is_file())
    assert [path.name for path in native if "pybind11" in source(path)] == ["bindings.cpp"]
    assert [path.name for path in native if "Python.h" in source(path)] == []


DRAWS_AS_SB3 = "policies/mirrored_replay.py"  # the numbers that SB3's buffers would draw
ALLOWED_OF_RANDOM = {"Generator", "default_rng", "SeedSequence", "PCG64", "BitGenerator"}


def test_no_global_random_state():
    """A generator is handed in or seeded; what others draw elsewhere changes nothing."""
    assert_none(forbidden(FILES, {"random", "numpy.random"}))
    assert_none(
        f"{named(path)}:{node.lineno}: {ast.unparse(node)}"
        for path in FILES
        for node in nodes(path)
        if isinstance(node, ast.Attribute)
        and ast.unparse(node.value) in ("np.random", "th.random")
        and node.attr not in ALLOWED_OF_RANDOM
        and (named(path), node.attr) != (DRAWS_AS_SB3, "randint")
    )


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


def test_no_file_is_longer_than_one_can_read():
    """And the list of those that may be is not longer than needed."""
    lengths = {named(path): code_lines(source(path)) for path in FILES}
    longer = {name: lines for name, lines in lengths.items() if lines > MAX_CODE_LINES}
    assert set(longer) == set(LONGER_FILES)
    assert [name for name, lines in longer.items() if lines > LONGER_FILES[name]] == []
