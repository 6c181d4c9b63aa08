"""The documentation says what the code does: tables are generated, snippets and commands run.

``python tests/test_docs.py`` writes the generated tables anew.
"""

from __future__ import annotations

import argparse
import ast
import configparser
import csv
import functools
import importlib.util
import inspect
import json
import pkgutil
import re
import shlex
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import gymnasium as gym
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from lint import assert_none, nodes, source, tracked, tree
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

import sb3_torcs  # noqa: F401  registers the environments
from sb3_torcs import cli, rewards
from sb3_torcs.agents.models import shipped_agents
from sb3_torcs.callbacks.metrics import DrivingMetricsCallback
from sb3_torcs.car import RANGE_FINDERS
from sb3_torcs.envs.torcs import TorcsEnv
from sb3_torcs.envs.torcs_lite import TorcsLiteEnv
from sb3_torcs.noise import BLOG
from sb3_torcs.sensors import GROUPS, feature_slices
from sb3_torcs.studies.config import read_study
from sb3_torcs.torcs.packages import VIDEO_PACKAGES
from sb3_torcs.torcs.track_names import BUNDLED_FOLDER
from sb3_torcs.tracks.catalogue import load_track
from sb3_torcs.training import zoo
from sb3_torcs.training.run import TrainOptions

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
PACKAGE = ROOT / "sb3_torcs"
SHORT = 150  # [timesteps] of a training in a snippet
OF_OTHERS = {  # commands of other programs
    "python3 -m venv .venv", "source .venv/bin/activate", "tensorboard --logdir logs/tensorboard",
}  # fmt: skip
ROBOTS = ("inferno", "berniw", "bt", "olethros", "tita", "lliaw")  # that have car1-trb1


# ------------------------------------------------------------------------------ generated tables


def markdown(headers, rows):
    """A table; ``|`` inside a cell would end it."""
    lines = [headers, ["---"] * len(headers), *rows]
    return "\n".join(f"| {' | '.join(c.replace('|', '&#124;') for c in row)} |" for row in lines)


def one_line(text):
    """Text in one line, with Markdown's code instead of reStructuredText's."""
    text = re.sub(r":\w+:`(?:~[\w.]+\.)?([^`]+)`", r"`\1`", " ".join(text.split()))
    return text.replace("``", "`")


def arguments(environment):
    """Rows of the keyword arguments of an environment, as its signature and docstring say."""
    parameters = inspect.signature(environment.__init__).parameters
    said = dict(re.findall(r":param (\w+): (.*?)(?=\n\s*:|\Z)", environment.__doc__, re.DOTALL))
    rows = []
    for name, parameter in parameters.items():
        if name == "self" or parameter.kind is parameter.VAR_KEYWORD:
            continue
        default = parameter.default
        shown = json.dumps(default) if isinstance(default, str) else repr(default)
        rows.append([f"`{name}`", f"`{shown}`", one_line(said[name])])
    return rows


def arguments_table():
    """Arguments of the real game, and which of them the other world takes, too."""
    shared = {name for name, *_ in arguments(TorcsLiteEnv)}
    rows = [
        [name, default, "yes" if name in shared else "", text]
        for name, default, text in arguments(TorcsEnv)
    ]
    return markdown(["argument", "default", "in Lite", "meaning"], rows)


def range_finders_table():
    rows = [
        [f'`"{name}"`', ", ".join(f"{angle:g}" for angle in angles)]
        for name, angles in RANGE_FINDERS.items()
    ]
    return markdown(["set", "angles"], rows)


def terms_table():
    rows = [[f"`{name}`", one_line(term.__doc__)] for name, term in rewards.TERMS.items()]
    return markdown(["term", "what it measures"], rows)


def presets_table():
    names = list(dict.fromkeys(key for preset in rewards.PRESETS.values() for key in preset))
    rows = [
        [f'`"{preset}"`', *(f"{weights[key]:g}" if key in weights else "" for key in names)]
        for preset, weights in rewards.PRESETS.items()
    ]
    return markdown(["preset", *(f"`{name}`" for name in names)], rows)


def tracks_table():
    rows = []
    for path in sorted(BUNDLED_FOLDER.glob("*/*.csv")):
        s = load_track(path.stem).summary()
        origin = path.read_text(encoding="utf-8").splitlines()[:2]
        sizes = [f"{size:.1f}" for size in (s.length_m, s.width_m, s.tightest_radius_m)]
        source = " ".join(line.lstrip("# ") for line in origin)
        rows.append([f"`{s.category}/{s.name}`", *sizes, source])
    return markdown(["track", "length m", "width m", "tightest radius m", "source"], rows)


def noise_table():
    actuators = ("steering", "throttle", "brake")
    rows = [[name, *(f"{value:g}" for value in p)] for name, p in zip(actuators, BLOG, strict=True)]
    return markdown(["actuator", "μ", "θ", "σ"], rows)


def tags_table():
    """The table in the callback's docstring, whose columns begin where their rules do."""
    lines = inspect.cleandoc(DrivingMetricsCallback.__doc__).splitlines()
    rules = [number for number, line in enumerate(lines) if line.startswith("====")]
    starts = [match.start() for match in re.finditer("=+", lines[rules[0]])]
    spans = list(zip(starts, [*starts[1:], None], strict=True))
    rows = [
        [one_line(line[first:last]) for first, last in spans]
        for line in lines[rules[0] + 1 : rules[2]]
        if not line.startswith("=")
    ]
    return markdown(rows[0], rows[1:])


def verbs_table():
    """What ``sb3-torcs --help`` says of its verbs."""

    parser = argparse.ArgumentParser()
    verbs = parser.add_subparsers()
    for verb in cli.VERBS:
        verb.add_parser(verbs)
    rows = [[f"`sb3-torcs {choice.dest}`", choice.help] for choice in verbs._choices_actions]
    return markdown(["verb", "does"], rows)


def sensor_table():
    """The base group, number by number."""
    lines = [
        "| Num | Sensor | SCR | Unit | Min | Max | Scale | Observation min | Observation max |",
        "|----:|--------|-----|------|----:|----:|------:|----:|----:|",
    ]
    where = feature_slices(("base",))
    for sensor in GROUPS["base"]:
        first, end = where[sensor.name].start, where[sensor.name].stop
        number = f"{first}" if sensor.size == 1 else f"{first}-{end - 1}"
        key = f"`{sensor.key}`" if sensor.key else ""
        lines.append(
            f"| {number} | `{sensor.name}` | {key} | {sensor.unit} | {sensor.low:.5g} | "
            f"{sensor.high:.5g} | {sensor.scale:.5g} | {sensor.low * sensor.scale:.5g} | "
            f"{sensor.high * sensor.scale:.5g} |"
        )
    return "\n".join(lines)


def sensor_groups_table():
    """All other groups, in the order in which an observation has them."""
    rows = [
        [
            f'`"{group}"`', f"`{sensor.name}`", f"{sensor.size}", sensor.unit,
            f"{sensor.low:.5g}", f"{sensor.high:.5g}", f"{sensor.scale:.5g}",
        ]
        for group, sensors in GROUPS.items()
        for sensor in sensors
        if group != "base"
    ]  # fmt: skip
    return markdown(["Group", "Sensor", "Numbers", "Unit", "Min", "Max", "Scale"], rows)


GENERATED = {
    "docs/commands.md": {"verbs": verbs_table},
    "docs/environments.md": {
        "arguments": arguments_table,
        "sensors": sensor_table,
        "sensor-groups": sensor_groups_table,
        "range-finders": range_finders_table,
        "terms": terms_table,
        "presets": presets_table,
    },
    "docs/tracks.md": {"tracks": tracks_table},
    "docs/training.md": {"tags": tags_table},
    "docs/policies.md": {"noise": noise_table},
}
TABLES = [(page, name) for page, tables in GENERATED.items() for name in tables]


def block_of(name):
    return re.compile(rf"(<!-- {name} -->\n)(.*?)(<!-- /{name} -->)", re.DOTALL)


@pytest.mark.parametrize(("page", "name"), TABLES)
def test_a_generated_table_has_not_drifted(page, name):
    found = block_of(name).search((ROOT / page).read_text(encoding="utf-8"))
    assert found, f"{page} has no block <!-- {name} -->"
    remedy = "the code has changed; type: python tests/test_docs.py"
    assert found[2].strip() == GENERATED[page][name](), remedy


def test_every_block_is_generated():
    """A marker that nothing fills would look as if something did."""
    found = {
        (str(page.relative_to(ROOT)), name)
        for page in PAGES
        for name in re.findall(r"<!-- /([\w-]+) -->", page.read_text(encoding="utf-8"))
    }
    assert found == set(TABLES)


def write_tables():
    for page, tables in GENERATED.items():
        path = ROOT / page
        text = path.read_text(encoding="utf-8")
        for name, table in tables.items():
            text = block_of(name).sub(lambda m, t=table: f"{m[1]}{t()}\n{m[3]}", text)
        path.write_text(text, encoding="utf-8")


# ------------------------------------------------------------------------------ snippets


def fenced(page, language):
    """Code blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text("utf-8"), re.DOTALL | re.M)


WITH_PYTHON = [page for page in PAGES if fenced(page, "python")]


@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: page.stem)
def test_the_snippets_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch, capsys):
    """Trainings are cut to a budget of seconds; nothing else is changed."""
    monkeypatch.chdir(tmp_path)
    begin = BaseAlgorithm._setup_learn

    def begin_short(model, total_timesteps, *args, **kwargs):
        return begin(model, min(total_timesteps, SHORT), *args, **kwargs)

    monkeypatch.setattr(BaseAlgorithm, "_setup_learn", begin_short)
    names = {"__name__": f"snippets_{page.stem}"}
    with patch.dict(rewards.TERMS):  # to which a page adds one
        for number, code in enumerate(fenced(page, "python"), 1):
            exec(compile(code, f"{page.name}, snippet {number}", "exec"), names)
    for value in names.values():
        if isinstance(value, gym.Env | VecEnv):
            value.close()
    assert "Error" not in capsys.readouterr().out


def test_the_page_on_architecture_has_a_world_in_forty_lines(capsys):
    world, drive = fenced(ROOT / "docs" / "architecture.md", "python")
    assert len([line for line in world.splitlines() if line.strip()]) <= 40
    names = {}
    exec(world + drive, names)
    assert capsys.readouterr().out.startswith("laps 20")  # metres of g-track-1: a whole lap
    check_gymnasium(names["env"], skip_render_check=True)
    names["env"].close()


def test_the_documented_json_is_what_evaluate_prints(capsys):
    (example,) = fenced(ROOT / "docs" / "evaluation.md", "json")
    words = "evaluate scripted --env TorcsLite-v0 --track g-track-1 --laps 1 --json"
    assert cli.main(words.split()) == 0
    assert shape(json.loads(example)) == shape(json.loads(capsys.readouterr().out))


def shape(value):
    """Keys and types."""
    if isinstance(value, dict):
        return {key: shape(item) for key, item in value.items()}
    return [shape(item) for item in value] if isinstance(value, list) else type(value)


# ------------------------------------------------------------------------------ commands


def commands(page):
    """Command lines in the shell blocks of a page, continuation lines joined."""
    for block in fenced(page, "sh"):
        yield from (line for line in block.replace("\\\n", " ").splitlines() if line.strip())


def inline(page):
    """Commands in running text. Blocks are cut out first: their fences are backticks, too."""
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.DOTALL | re.M)
    return re.findall(r"`((?:sb3-torcs|make) [^`…]+)`", text)


SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg", "utf-8")
EXTRAS = SETUP.options("options.extras_require")
TARGETS = {
    target
    for line in re.findall(r"^([a-z][a-z -]*):", (ROOT / "Makefile").read_text("utf-8"), re.M)
    for target in line.split()
}


@pytest.fixture
def parsed(monkeypatch):
    """Reads a command line of ours as the command does, and returns what it found."""
    found = []
    for verb in cli.VERBS:
        monkeypatch.setattr(verb, "run", lambda args: found.append(args) or 0)

    def read(words):
        try:
            cli.main(words)
        except SystemExit:
            raise AssertionError("does not parse") from None
        return found[-1]

    return read


def parsed_by_the_zoo(words, monkeypatch):
    """Reads a command line of the zoo's training up to where it would begin."""
    import rl_zoo3.train as train

    class Parsed(Exception):
        pass

    def stop(args, *rest, **options):
        raise Parsed(args)

    monkeypatch.setattr(train, "ExperimentManager", stop)
    monkeypatch.setattr(train, "set_random_seed", lambda seed: None)
    monkeypatch.setattr(train.th, "set_num_threads", lambda threads: None)
    monkeypatch.setattr(sys, "argv", ["train", *words])
    with pytest.raises(Parsed) as caught:
        train.train()
    return caught.value.args[0]


def faults_of_commands(commands_in, check_line):
    """The command lines of all pages that fail a check, each distinct one checked once."""
    checked = {}
    for page in PAGES:
        for line in commands_in(page):
            if line not in checked:
                try:
                    checked[line] = check_line(line)
                except Exception as error:
                    checked[line] = error
            if checked[line] is not None:
                yield f"{where(page, line)}: `{line}`: {checked[line]!r}"


def where(page, text):
    """The page and the first line of it that holds a text, or the beginning of one."""
    for number, line in enumerate(source(page).splitlines(), 1):
        if text.partition("\\")[0][:60].rstrip() in line:
            return f"{page.relative_to(ROOT)}:{number}"
    return f"{page.relative_to(ROOT)}"


def test_commands_in_the_docs_parse_and_name_what_exists(parsed, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert_none(faults_of_commands(commands, functools.partial(check_shown, parsed, monkeypatch)))


def check_shown(parsed, monkeypatch, line):
    match shlex.split(line, comments=True):
        case ["sb3-torcs", *words]:
            check(parsed(words))
        case ["python", "-m", "rl_zoo3.train", *words]:
            check_zoo(parsed_by_the_zoo(words, monkeypatch))
        case ["python", "-m", "sb3_torcs.rl_zoo", script, *words]:
            call = [sys.executable, "-m", "sb3_torcs.rl_zoo", script, *words, "--help"]
            told = subprocess.run(call, capture_output=True, check=True, text=True).stdout
            flags = {word for word in words if word.startswith("-")}
            assert flags <= set(re.split(r"[\s,]+", told))
        case ["make", target, *_]:
            assert target in TARGETS
        case ["python" | "sh", script, *_]:
            assert (ROOT / script).parent in (ROOT / "examples", ROOT / "tools")
            assert (ROOT / script).is_file()
        case ["pip", "install", what] | ["SB3_TORCS_WITHOUT_ENGINE=1", "pip", "install", what]:
            assert what in (".", *(f".[{extra}]" for extra in EXTRAS))
        case ["pip", "install", "torch", "--index-url", address]:
            assert address in (ROOT / "tools" / "make-environment").read_text("utf-8")
        case ["sudo", "apt", "install", *packages]:
            tools = {"git", "make", "g++", "python3-dev", "python3-venv"}
            assert set(packages) <= {*tools, *VIDEO_PACKAGES}
        case other:
            assert " ".join(other) in OF_OTHERS


def test_commands_in_the_text_parse(parsed):
    assert_none(faults_of_commands(inline, functools.partial(check_mentioned, parsed)))


def check_mentioned(parsed, line):
    match shlex.split(line):
        case ["sb3-torcs", "evaluate" | "compare" | "watch" | "compete" | "study"
              | "optimize-lap" | "race"]:  # fmt: skip
            pass  # the verb alone, which needs to be told what to do it with
        case ["sb3-torcs", *words]:
            parsed(words)
        case ["make", word]:
            assert word in TARGETS or re.fullmatch(r"(PYTHON|WORKERS)=\S+", word)
        case ["make", target, *_]:
            assert target in TARGETS


def check(args):
    """Look up what a command of ours names."""
    import numpy as np

    for name in [args.track] if getattr(args, "track", None) else getattr(args, "names", ()):
        load_track(name, np.random.default_rng(0))
    if args.verb == "train":
        algo, env = args.algo or TrainOptions.algo, args.env or TrainOptions.env
        file, name = zoo.config_file(algo, args.conf_file), args.entry or env
        entry = zoo.read_entry(file, name)
        zoo.checked_env(entry, env, zoo.Place(file, name)).close()
        assert set(dict(args.hyperparams)) <= set(entry)
    if args.verb == "study" and not args.report:
        assert read_study(args.file).trials
    if args.verb == "evaluate":
        saved = r"logs/(?:\w+/)?(\w+)/Torcs(?:Lite)?-v0_1(?:/best_model\.zip)?"
        run = re.fullmatch(saved, args.driver)
        named = ("scripted", *shipped_agents(), *ROBOTS)
        assert args.driver.partition(":")[0] in named or zoo.config_file(run[1])


def check_zoo(args):
    """Look up what a command of the zoo names."""
    environment = {"TorcsLite-v0": TorcsLiteEnv, "Torcs-v0": TorcsEnv}[args.env]
    allowed = inspect.signature(environment.__init__).parameters
    zoo.read_entry(Path(args.conf_file), args.env)
    assert Path(args.conf_file).stem == args.algo
    for keywords in (args.env_kwargs or {}, args.eval_env_kwargs or {}):
        assert keywords.keys() <= allowed.keys()
        load_track(keywords.get("track", "aalborg"))


# ------------------------------------------------------------------------------ names in the text


WRITTEN = {  # by runs and by people: files that docs name and that are not the project's
    "__pycache__", "0.monitor.csv", "args.yml", "config.yml", "monitor.csv", "my.yml", "recipe.yml",
    "laps.csv", "report.html", "report.md", "results.csv",
}  # fmt: skip
TOOLS_FLAGS = {"--logdir"}  # of TensorBoard
NOT_IN_THE_PACKAGE = {  # Python's, Gymnasium's, SB3's, PyTorch's, the game's
    "True", "False", "None", "Box", "DDPG", "PPO", "SAC", "TD3", "DummyVecEnv", "SubprocVecEnv",
    "SyncVectorEnv", "RecordVideo", "TimeLimit", "VecNormalize", "Monitor", "MlpPolicy",
    "TD3Policy", "RecurrentPPO", "SCR", "Graphic",
    "NormalizeObservation", "ObservationWrapper", "ParallelTrainCallback", "RewardWrapper",
    "TimeAwareObservation", "VecVideoRecorder", "Wrapper",
    "learn", "predict", "render", "reset", "env_method", "make", "make_vec", "load",
    "set_num_threads", "parameters",
}  # fmt: skip
FILE = (
    r"[\w./-]+\.(?:py|h|cpp|md|yml|csv|sha256|webp)"
    r"|(?:sb3_torcs|native|examples|tools|tests)/[\w/]*"
)
DOTTED = r"(sb3_torcs(?:\.\w+)+)\b(?!/).*"
NAME = r"(?:[a-z]\w*\.)*(?:([A-Z]\w*[a-z]\w*)(?:\.\w+)?(?:\(.*\))?|([a-z]\w*)\(.*\))"


def spoken(page):
    """What stands in backticks in running text."""
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.DOTALL | re.M)
    return re.findall(r"`([^`\n]+)`", text)


def names_in(pattern):
    """Names of one form that the pages' texts hold, each once a page."""
    for page in PAGES:
        matches = [re.fullmatch(pattern, text) for text in dict.fromkeys(spoken(page))]
        yield from ((page, next(filter(None, m.groups()), m[0])) for m in matches if m)


@functools.cache
def defined():
    """Names of all classes, functions and constants, in Python and in C++."""
    kinds, names = (ast.ClassDef, ast.FunctionDef), set()
    for path in PACKAGE.rglob("*.py"):
        names |= {node.name for node in nodes(path) if isinstance(node, kinds)}
    for path in (PACKAGE / "native").rglob("*.h"):
        names |= set(re.findall(r"(?:class|struct) (\w+)", path.read_text("utf-8")))
    return names


def known_flags():
    parser = argparse.ArgumentParser()
    verbs = parser.add_subparsers()
    for verb in cli.VERBS:
        verb.add_parser(verbs)
    known = {"--version", *TOOLS_FLAGS}
    for verb in verbs.choices.values():
        known |= {option for action in verb._actions for option in action.option_strings}
    zoo_train = Path(importlib.util.find_spec("rl_zoo3.train").origin)
    scripts = [path for folder in ("examples", "tools") for path in (ROOT / folder).glob("*.py")]
    for path in [zoo_train, *scripts]:
        known |= set(re.findall(r"\"(--[\w-]+)\"", path.read_text("utf-8")))
    return known


def is_there(name):
    """Whether a file, or a folder that ends with a slash; NAME stands for any."""
    ending = "" if name.endswith("/") else "$"
    pattern = "/" + re.escape(name).replace("NAME", r"[\w-]+") + ending
    return (
        bool(re.search(pattern, "".join(f"/{file}\n" for file in tracked()), re.M))
        or Path(name).name in WRITTEN
    )


def unknown(pattern, exists):
    return [f"{where(page, name)}: {name}" for page, name in names_in(pattern) if not exists(name)]


def imports(name):
    """Whether a dotted path names a module, or something in one."""
    try:
        return pkgutil.resolve_name(name) is not None
    except (AttributeError, ImportError):
        return False


def test_what_the_docs_name_is_there():
    named, flags = NOT_IN_THE_PACKAGE | defined(), known_flags()
    assert_none(unknown(FILE, is_there))
    assert_none(unknown(DOTTED, imports))
    assert_none(unknown(NAME, named.__contains__))
    assert_none(
        f"{where(page, flag)}: {flag}"
        for page in PAGES
        for text in spoken(page)
        for flag in re.findall(r"(?<!\S)--[a-z][\w-]*", text)
        if flag not in flags
    )


# ------------------------------------------------------------------------------ links, docstrings


def slug(heading):
    """The anchor that GitHub gives to a heading."""
    kept = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return kept.replace(" ", "-")


def lost_links(page):
    for number, line in enumerate(source(page).splitlines(), 1):
        for target in re.findall(r"\]\(([^)\s]+)\)", line):
            if not target.startswith(("http://", "https://")) and not leads_somewhere(page, target):
                yield f"{page.relative_to(ROOT)}:{number}: {target}"


def leads_somewhere(page, target):
    name, _, anchor = target.partition("#")
    path = (page.parent / name) if name else page
    if not anchor or not path.exists():
        return path.exists()
    return anchor in map(slug, re.findall(r"^#+ (.*)$", source(path), re.M))


def test_local_links_lead_somewhere():
    pages = [*PAGES, *PACKAGE.glob("agents/*/README.md")]
    assert_none(fault for page in pages for fault in lost_links(page))


def test_tables_of_results_are_whole_and_listed():
    """Each file is a rectangle with a header, and the index has its number of rows."""
    folder = ROOT / "docs" / "results"
    index = (folder / "index.csv").read_text("utf-8").splitlines()
    listed = {row["file"]: row for row in csv.DictReader(index)}
    assert {"index.csv", *listed} == {path.name for path in folder.iterdir()}
    for name, row in listed.items():
        header, *rows = csv.reader((folder / name).read_text("utf-8").splitlines())
        assert all(header), name
        assert len(set(header)) == len(header), name
        assert {len(cells) for cells in rows} == {len(header)}, name
        assert len(rows) == int(row["rows"]), name


def test_the_pictures_are_small_enough_for_a_first_look():
    pictures = list((ROOT / "docs" / "images").iterdir())
    most = {".png": 200_000, ".webp": 1_000_000, ".mp4": 3_000_000}  # [bytes]
    assert [p.name for p in pictures if p.stat().st_size > most.get(p.suffix, 0)] == []


def undocumented(node):
    """Public definitions in a module or class that have no docstring."""
    definitions = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for child in node.body:
        if not isinstance(child, definitions) or child.name.startswith("_"):
            continue
        if ast.get_docstring(child) is None:
            yield child.lineno, child.name
        if isinstance(child, ast.ClassDef):
            yield from undocumented(child)


def test_everything_public_has_a_docstring():
    paths = [path for path in sorted(PACKAGE.rglob("*.py")) if tree(path).body]
    assert [path for path in paths if not ast.get_docstring(tree(path))] == []
    assert_none(
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in paths
        for line, name in undocumented(tree(path))
    )


if __name__ == "__main__":
    write_tables()
