"""What can be wrong with a game, a file or a call: each has its own error, and none a crash.

Whatever could crash runs in a process of its own: there its crash is a failed test.
"""

from __future__ import annotations

import json
import math
import os
import re
import threading
import time
from contextlib import nullcontext
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from game_copy import attempts, compiled, copy_game, python, replace
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_torcs.backends.native import NativeBackend, make_engine
from sb3_torcs.car import Controls
from sb3_torcs.errors import (
    EngineBusy,
    EnvClosed,
    GameIncomplete,
    GameNotFound,
    InvalidAction,
    InvalidOption,
    TrackFileError,
    TrackNotFound,
    UnknownCar,
    UnknownRobot,
)
from sb3_torcs.torcs.installation import MODULES, SURFACES, find_game
from sb3_torcs.torcs.starting_list import AGENT

pytestmark = pytest.mark.usefixtures("game")

INSTALL = "sb3-torcs install-torcs"
SMALL = "g-track-1"  # loads in no time
INFERNO = [["inferno", 3]]

BEGIN = """
import json, math, os, sys, threading, numpy as np
from sb3_torcs import errors
from sb3_torcs.backends.native import NativeBackend, NativeFleet, make_engine
from sb3_torcs.torcs.starting_list import AGENT
from sb3_torcs.car import Controls, Start
from sb3_torcs.torcs.installation import find_game

def engine(track="g-track-1", entries=(AGENT,), **options):
    return make_engine(find_game(), track, list(entries), **options)

def raised(call):
    try:
        call()
    except Exception as error:
        return type(error).__name__
    return "nothing"
"""


@pytest.fixture
def copy(game, tmp_path):
    """A game to break, and its folders."""
    root = copy_game(game, tmp_path / "game")
    return root, root / "share/games/torcs", root / "lib/torcs"


def attempt(home, **options):
    ((name, message),) = attempts(home, {"track": SMALL, **options})
    return name, message


def refused(home, errors, *words, **options):
    """A race is not loaded, for one of the errors, and the message has the words."""
    name, message = attempt(home, **options)
    assert name in errors.split("|"), message
    assert [word for word in words if word not in message] == [], message


OTHER_PARSER = """
#include <cstdlib>
extern "C" void* XML_ParserCreate(const char*) { std::abort(); }
"""


def test_the_game_reads_its_files_with_its_own_parser_not_with_the_process_s(tmp_path):
    # Debian's own Python and those of uv and conda have another version of expat in the process.
    preload = os.pathsep.join(
        [os.environ.get("LD_PRELOAD", ""), str(compiled(OTHER_PARSER, tmp_path / "expat.so"))]
    )
    code = f"{BEGIN}\nengine().close()\nprint('drives')"
    assert python(code, LD_PRELOAD=preload.strip(os.pathsep)) == "drives\n"


class TestInstallation:
    def test_none(self, monkeypatch, tmp_path):
        monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path))
        with pytest.raises(GameNotFound, match=INSTALL):
            gym.make("Torcs-v0")

    def test_a_whole_one(self, copy):
        entries = [["", 0], ["inferno", 3]]
        assert attempt(copy[0], entries=entries, session="race") == ("nothing", "")

    @pytest.mark.parametrize("module", MODULES)
    def test_without_a_module(self, copy, monkeypatch, module):
        root, _, libraries = copy
        (libraries / module).unlink()
        monkeypatch.setenv("SB3_TORCS_HOME", str(root))
        with pytest.raises(GameIncomplete, match=f"{module}.*{INSTALL}"):
            gym.make("Torcs-v0")

    def test_without_surfaces(self, copy, monkeypatch):
        root, data, _ = copy
        original = (data / "data").resolve()
        (data / "data").unlink()
        (data / "data/tracks").mkdir(parents=True)
        (data / "data/tracks/objects.xml").symlink_to(original / "tracks/objects.xml")
        monkeypatch.setenv("SB3_TORCS_HOME", str(root))
        with pytest.raises(GameIncomplete, match=f"{SURFACES}.*{INSTALL}"):
            gym.make("Torcs-v0")

    def test_without_a_track_s_file(self, copy, monkeypatch):
        root, data, _ = copy
        (data / "tracks/road/aalborg/aalborg.xml").unlink()
        monkeypatch.setenv("SB3_TORCS_HOME", str(root))
        with pytest.raises(GameIncomplete, match=f"track 'aalborg' has no .*{INSTALL}"):
            NativeBackend("aalborg")

    def test_without_the_session(self, copy):
        root, data, _ = copy
        config = (data / "config").resolve()
        (data / "config").unlink()
        (data / "config/raceman").mkdir(parents=True)
        for path in config.glob("*.xml"):
            (data / "config" / path.name).symlink_to(path)
        refused(root, "GameIncomplete", "config/raceman/practice.xml")

    @pytest.mark.parametrize("module", MODULES)
    @pytest.mark.parametrize("content", [b"", b"no library", None], ids=["empty", "text", "half"])
    def test_with_a_module_that_is_none(self, copy, module, content):
        """Half of one is what a full disk leaves."""
        root, _, libraries = copy
        whole = (libraries / module).read_bytes()
        replace(libraries / module, whole[: len(whole) // 2] if content is None else content)
        named = [] if content is None else [module]
        refused(root, "GameIncomplete|BackendUnavailable", *named, INSTALL)

    @pytest.mark.parametrize("module", ["modules/track/track.so", "modules/simu/simuv2.so"])
    def test_with_another_module_of_that_name(self, copy, module):
        root, _, libraries = copy
        replace(libraries / module, (libraries / "drivers/berniw/berniw.so").read_bytes())
        refused(root, "LayoutMismatch", INSTALL)

    def test_two_games_in_one_process(self, copy):
        code = BEGIN + "engine().close(); os.environ['SB3_TORCS_HOME'] = sys.argv[1]\n"
        code += "try: engine()\nexcept errors.BackendUnavailable as error: print(error)"
        message = python(code, str(copy[0]))
        assert "has already loaded the game in" in message
        assert "start another process" in message


# Robots that plan by splines seek an interval by halving. With two knots it never ends for a number
# before the first.
SPLINES = """
static void nothing() {{}}
double spline(int dim, double z, const double* x, const double* y, const double* slopes) {{
    int a = 0, b = dim - 1, i;
    do {{
        i = (a + b) / 2;
        if (x[i] <= z) a = i; else b = i;
    }} while (a + 1 != b);
    return y[a];
}}
{family}
static int init(int, void* to) {{
    const double x[] = {{1.0, 2.0}}, y[] = {{5.0, 8.0}}, slopes[] = {{3.0, 3.0}};
    void** table = (void**)to;
    for (int i = 0; i < 6; i++) table[i] = (void*)nothing;
    return spline(2, {at}, x, y, slopes) == {value} ? 0 : -1;
}}
"""
FAMILY = "void parametricslopesp(int, const double*, const double*, double*, double*, double*) {}"

# Modules that any version could have: they fill the tables that the game asks for.
MODULE = """
#include <cstdlib>
#include <cstring>
struct Info {{
    const char* name;
    const char* text;
    int (*init)(int, void*);
    unsigned id;
    int index;
}};
{body}
extern "C" int {name}(Info* info) {{
    std::memset(info, 0, 10 * sizeof(Info));
    info->name = info->text = "{name}";
    info->init = init;
    info->index = 0;
    return 0;
}}
"""
TRACK = """
static void* build(char*) {{ {build} }}
static void shut() {{}}
static int init(int, void* to) {{
    void** table = (void**)to;
    for (int i = 0; i < 9; i++) table[i] = (void*)shut;
    table[0] = table[1] = (void*)build;
    return 0;
}}
"""
TRACKS = {
    "nothing": "return nullptr;",
    "zeros": "return std::calloc(1, 4096);",
    "noise": "char* p = (char*)std::malloc(4096); std::memset(p, 0x5a, 4096); return p;",
    "wild pointers": "long* p = (long*)std::calloc(1, 4096);"
    "for (int i = 0; i < 512; i++) p[i] = 0x7000000000000000 + 8 * i; return p;",
    "a small record": "return std::calloc(1, 16);",
}
SIMULATIONS = {
    "no table": "",
    "an empty table": "void* SimCarTable = nullptr;",
    "zeros": "void* SimCarTable = std::calloc(1, 1 << 20);",
    "a table elsewhere": "void* SimCarTable = (void*)0x7000000000000000;",
}
SIMULATION = """
{table}
static void nothing() {{}}
static int init(int, void* to) {{
    void** table = (void**)to;
    for (int i = 0; i < 5; i++) table[i] = (void*)nothing;
    return 0;
}}
"""


class TestOtherVersions:
    @pytest.mark.parametrize("kind", TRACKS)
    def test_a_track_laid_out_otherwise(self, copy, kind):
        root, _, libraries = copy
        body = TRACK.format(build=TRACKS[kind])
        compiled(MODULE.format(body=body, name="track"), libraries / "modules/track/track.so")
        refused(root, "LayoutMismatch", "expected", INSTALL)

    @pytest.mark.parametrize("kind", SIMULATIONS)
    def test_a_simulation_laid_out_otherwise(self, copy, kind):
        root, _, libraries = copy
        body = SIMULATION.format(table=SIMULATIONS[kind])
        compiled(MODULE.format(body=body, name="simuv2"), libraries / "modules/simu/simuv2.so")
        refused(root, "LayoutMismatch", INSTALL)

    def test_a_library_without_a_function(self, copy):
        root, _, libraries = copy
        compiled("", libraries / "lib/librobottools.so")
        refused(root, "LayoutMismatch", "librobottools.so has no symbol")

    def test_the_doctor_tells_it_too(self, copy):
        root, _, libraries = copy
        body = TRACK.format(build=TRACKS["zeros"])
        compiled(MODULE.format(body=body, name="track"), libraries / "modules/track/track.so")
        code = "from sb3_torcs.backends.native import check_layout\n"
        code += "try: check_layout(find_game())\nexcept errors.LayoutMismatch as told: print(told)"
        assert "1.3.7" in python(BEGIN + code, SB3_TORCS_HOME=str(root))


def changed(pattern, replacement, text, count=1):
    new = re.sub(pattern, replacement, text, count=count, flags=re.DOTALL)
    assert new != text, f"{pattern} is not there"
    return new


def value(name, new):
    """What changes the first value of a name."""
    return rf'(name="{name}"[^>]*val=")[^"]*"', rf'\g<1>{new}"'


MAIN_WIDTH = r'(<section name="Main Track">.*?<attnum name="width"[^>]*val=")[^"]*"'
PIT_LENGTH = r'(<section name="Pits">.*?<attnum name="length"[^>]*val=")[^"]*"'
FAR_GRID = """<section name="Starting Grid">
  <attnum name="distance to start" val="30000"/>
</section>"""
BROKEN_TRACKS = {
    "empty": lambda text: "",
    "truncated": lambda text: text[: len(text) // 2],
    "another format": lambda text: "<html/>",
    "zeros": lambda text: "\0" * 1000,
    "no segments": lambda text: changed(
        r'(<section name="Track Segments">).*', r"\1</section></section></params>", text
    ),
    "negative length": lambda text: changed(*value("lg", -100), text),
    "zero length": lambda text: changed(*value("lg", 0), text),
    "nan": lambda text: changed(*value("lg", "nan"), text),
    "infinite": lambda text: changed(*value("lg", "inf"), text),
    "absurd length": lambda text: changed(*value("lg", "1e30"), text),
    "zero radius": lambda text: changed(*value("radius", 0), text),
    "no width": lambda text: changed(MAIN_WIDTH, r'\g<1>0"', text),
    "negative width": lambda text: changed(MAIN_WIDTH, r'\g<1>-15"', text),
    "surfaces elsewhere": lambda text: text.replace("data/tracks/surfaces", "nowhere/surfaces"),
    "another version": lambda text: changed(*value("version", 9), text),
    "negative version": lambda text: changed(*value("version", -1), text),
    "negative friction": lambda text: changed(*value("friction", -1), text),
    "no pits": lambda text: changed(PIT_LENGTH, r'\g<1>0"', text),
    "short pits": lambda text: changed(PIT_LENGTH, r'\g<1>1e-30"', text),
    "grid beyond": lambda text: changed('<section name="Main Track">', rf"{FAR_GRID}\g<0>", text),
}


def circle(arcs, radius):
    """A track that bends to the left for ever: degrees and metres."""
    segments = "".join(
        f"""<section name="{number}"><attstr name="type" val="lft"/>
        <attnum name="arc" unit="deg" val="{arc}"/><attnum name="radius" val="{radius}"/>
        </section>"""
        for number, arc in enumerate(arcs)
    )
    return f"""<params name="circle"><section name="Header">
        <attstr name="name" val="circle"/><attnum name="version" val="4"/></section>
        <section name="Main Track"><attnum name="width" val="10"/>
        <section name="Track Segments">{segments}</section></section></params>"""


TOO_MANY_MAPS = """
import mmap
from contextlib import suppress
engine().close()
maps, races = [], []
with suppress(OSError):
    for _ in range(10**6):
        maps.append(mmap.mmap(-1, 1))
del maps[-60:]
try:
    for _ in range(60):
        races.append(engine())
except errors.BackendUnavailable as error:
    print(error)
"""


def test_more_races_than_the_machine_maps_libraries_for():
    """It is no fault of the game's, so the advice is not to install it again."""
    if int(Path("/proc/sys/vm/max_map_count").read_text()) > 10**6:
        return  # nobody reaches it
    advice = r"hold fewer races .* sudo sysctl vm.max_map_count=1000000$"
    assert re.search(advice, python(BEGIN + TOO_MANY_MAPS))


class TestTracks:
    def test_broken_files(self, copy, game):
        root, data, _ = copy
        text = game.tracks()[f"road/{SMALL}"].read_text(encoding="utf-8", errors="replace")
        paths = []
        for name, breaking in {"whole": lambda text: text, **BROKEN_TRACKS}.items():
            short = name.replace(" ", "-")
            paths.append(replace(data / f"tracks/road/{short}/{short}.xml", breaking(text)))
        found = attempts(root, *({"track": str(path)} for path in paths))
        assert found[0] == ("nothing", "")
        wrong = {
            path.stem: raised
            for path, raised in zip(paths[1:], found[1:], strict=True)
            if raised[0] != "TrackFileError" or path.name not in raised[1]
        }
        assert wrong == {}

    @pytest.mark.parametrize(
        ("arcs", "radius", "message"),
        [
            ((180, 180), 100, None),
            ((240, 120), 100, "turns by 240 degrees, and 180 is the most"),
            ((180, 180), 9, "is 57 m long, and its grid has place 1 100 m before the line"),
        ],
    )
    def test_a_circle(self, arcs, radius, message, tmp_path):
        path = tmp_path / "circle.xml"
        path.write_text(circle(arcs, radius))
        with pytest.raises(TrackFileError, match=message) if message else nullcontext():
            NativeBackend(path)

    @pytest.mark.parametrize(
        ("track", "error", "message"),
        [
            *[(name, TrackNotFound, "`sb3-torcs tracks` lists them") for name in
              ("aalbrog", "road/aalbrog", "", "oval/aalborg", "../aalborg")],
            *[(name, InvalidOption, "name of an installed track") for name in ("random", 7, None)],
            (Path("nowhere.xml"), (TrackNotFound, TrackFileError), r"nowhere\.xml"),
        ],
    )  # fmt: skip
    def test_a_name_that_is_none(self, track, error, message):
        with pytest.raises(error, match=message):
            NativeBackend(track)

    @pytest.mark.parametrize("folder", ["a-b", "with space", "ünïcödé", "100% & <more>"])
    def test_a_path_of_any_kind(self, copy, folder):
        """Absolute, relative and with a tilde; a dash is in most tracks' names, too."""
        root, data, _ = copy
        own = data / "tracks/road" / folder
        name = "my-own.track"
        original = (data / f"tracks/road/{SMALL}/{SMALL}.xml").read_bytes()
        path = replace(own / f"{name}.xml", original)
        code = BEGIN + (
            "seen = set()\n"
            "for track in sys.argv[1:]:\n"
            "    backend = NativeBackend(track)\n"
            "    state = backend.reset(None, None)\n"
            "    seen.add((backend.track.name, *backend.step(Controls(0, 1, 0), 50)[:23]))\n"
            "    backend.close()\n"
            "print(len(seen), os.getcwd())\n"
        )
        words = [str(path), f"./{name}.xml", f"../{folder}/{name}.xml", f"~/{name}.xml"]
        home = {"SB3_TORCS_HOME": str(root), "HOME": str(own)}
        assert python(code, *words, cwd=own, **home).strip() == f"1 {own}"

    def test_the_same_track_by_path_and_by_name(self, game):
        name = NativeBackend("e-track-5")
        path = NativeBackend(game.tracks()["oval/e-track-5"])
        drives = []
        for backend in (name, path):
            backend.reset(np.random.default_rng(0), None)
            drives.append(backend.step(Controls(0.0, 1.0, 0.0), 200)[:23])
        assert drives[0] == drives[1]


BROKEN_CARS = {
    "empty": lambda text: "",
    "truncated": lambda text: text[: len(text) // 2],
    "no section": lambda text: "<params/>",
    "binary": lambda text: "\x7fELF\1\2",
    "no category": lambda text: changed(r'<attstr name="category"[^>]*>', "", text),
    "no mass": lambda text: changed(*value("mass", 0), text),
    "negative mass": lambda text: changed(*value("mass", -900), text),
    "mass is no number": lambda text: changed(*value("mass", "nan"), text),
}
IDLE_CARS = {  # what is left out comes from the category, so there are an engine and gears
    "another category": lambda text: changed(*value("category", "nope"), text),
    "no wheels": lambda text: changed(
        *value("tire width", 0), changed(*value("rim diameter", 0), text, 0), 0
    ),
    "no fuel tank": lambda text: changed(*value("fuel tank", 0), text),
    "no inertia": lambda text: changed(*value("inertia", 0), text, 0),
}


class TestCars:
    def tried(self, copy, breakages):
        root, data, _ = copy
        text = (data / "cars/car1-trb1/car1-trb1.xml").read_text(errors="replace")
        names = []
        for number, breaking in enumerate(breakages.values()):
            names.append(f"mine{number}")
            replace(data / f"cars/mine{number}/mine{number}.xml", breaking(text))
        found = attempts(root, *({"track": SMALL, "car": name} for name in names))
        return {
            what: raised
            for what, name, raised in zip(breakages, names, found, strict=True)
            if raised[0] != "CarFileError" or name not in raised[1]
        }

    def test_broken_files(self, copy):
        assert self.tried(copy, {"whole": lambda text: text}) == {"whole": ("nothing", "")}
        assert self.tried(copy, BROKEN_CARS) == {}

    @pytest.mark.parametrize("what", IDLE_CARS)
    def test_a_car_that_cannot_drive(self, copy, what):
        assert self.tried(copy, {what: IDLE_CARS[what]}) == {}

    def test_a_name_that_is_none(self):
        with pytest.raises(UnknownCar, match="did you mean 'car1-trb3'"):
            NativeBackend(SMALL, car="car1-trb2")


class TestRobots:
    @pytest.mark.parametrize(
        ("robot", "message"),
        [("infernoo", "did you mean 'inferno'"), ("inferno:77", "no index 77; it has")],
    )
    def test_a_name_or_an_index_that_is_none(self, robot, message):
        with pytest.raises(UnknownRobot, match=message):
            NativeBackend(SMALL, opponents=(robot,))

    @pytest.mark.parametrize(
        ("content", "error"),
        [(b"", "RobotUnavailable"), (b"no library", "RobotUnavailable"), (None, "UnknownRobot")],
    )
    def test_a_module_that_does_not_load(self, copy, content, error):
        root, _, libraries = copy
        replace(libraries / "drivers/inferno/inferno.so", content)
        refused(root, error, "inferno", entries=INFERNO)

    @pytest.mark.parametrize(
        ("content", "error"),
        [("<params", "GameIncomplete"), ("", "GameIncomplete"), (None, "UnknownRobot")],
    )
    def test_a_description_that_is_none(self, copy, content, error):
        root, data, _ = copy
        replace(data / "drivers/inferno/inferno.xml", content)
        refused(root, error, "inferno", entries=INFERNO)

    def test_a_module_of_another_robot(self, copy):
        root, _, libraries = copy
        other = (libraries / "drivers/berniw/berniw.so").read_bytes()
        replace(libraries / "drivers/inferno/inferno.so", other)
        refused(root, "LayoutMismatch|RobotUnavailable", entries=INFERNO)

    @pytest.mark.parametrize(
        ("family", "at", "value"),
        [(FAMILY, 0.0, 2.0), (FAMILY, 1.5, 6.5), (FAMILY, 3.0, 11.0), ("", 1.5, 5.0)],
        ids=["before", "between", "behind", "another family's"],
    )
    def test_a_spline_before_whose_begin_the_game_hangs(self, copy, family, at, value):
        """The robot's own one returns the first value; only those of the family are replaced."""
        root, _, libraries = copy
        body = SPLINES.format(family=family, at=at, value=value)
        source = MODULE.format(body=body, name="inferno").replace("index = 0", "index = 3")
        compiled(source, libraries / "drivers/inferno/inferno.so")
        assert attempt(root, entries=INFERNO) == ("nothing", "")

    def test_a_failure_leaves_the_others_as_they_were(self):
        code = BEGIN + (
            "def drive():\n"
            "    race = engine(entries=[('bt', 3), AGENT], session='race')\n"
            "    race.start(); race.advance(200)\n"
            "    return race.read(0)[:23]\n"
            "first = drive()\n"
            "for options in ({'track': 'nope'}, {'car': 'nope'}, {'entries': [('bt', 99)]}):\n"
            "    assert raised(lambda: engine(**options)) != 'nothing'\n"
            "print(drive() == first)"
        )
        assert python(code).strip() == "True"


# Each in a process of its own, since it may be its end.
WRONG = {
    "to read no car": ("engine().read(1)", "InvalidOption"),
    "to read a car before the first": ("engine().read(-1)", "InvalidOption"),
    "controls of no car": ("engine().controls(9999)", "InvalidOption"),
    "name of no car": ("engine().car_name(99999)", "InvalidOption"),
    "laps of no car": ("engine().laps(99999)", "InvalidOption"),
    "focus of no car": ("engine().focus(9999, 0.0)", "InvalidOption"),
    "nobody to step": ("engine(entries=[('bt', 3)]).step(0, 0, 0, None, 5)", "InvalidOption"),
    "nobody to start": ("engine(entries=[('bt', 3)]).start_at(100, 0, 0, 9)", "InvalidOption"),
    "nobody to replay": (
        "engine(entries=[('bt', 3)]).replay(np.zeros((3, 3)), True)", "InvalidOption"
    ),
    "nobody at all": ("engine(entries=[])", "InvalidOption"),
    "the same agent twice": ("engine(entries=[AGENT, AGENT])", "InvalidOption"),
    "to hold no car": ("engine().hold(9999, 0, 0, 0, None)", "InvalidOption"),
    "to retire no car": ("engine().retire(9999)", "InvalidOption"),
    "to rejoin with no car": ("engine().rejoin(9999, 0, 0, 9)", "InvalidOption"),
    "to rejoin nowhere": ("engine().rejoin(0, math.nan, 0, 9)", "InvalidOption"),
    "finish of no car": ("engine().finished(9999)", "InvalidOption"),
    "controls of two numbers": ("engine().replay(np.zeros((3, 2)), True)", "InvalidAction"),
    "before the start": ("engine().start_at(-1.0, 0, 0, 0)", "InvalidOption"),
    "nowhere": ("engine().start_at(math.nan, 0, 0, 0)", "InvalidOption"),
    "askew": ("engine().start_at(9.0, 0, math.nan, 0)", "InvalidOption"),
    "beside the world": ("engine().start_at(9.0, math.inf, 0, 0)", "InvalidOption"),
    "without a speed": ("engine().start_at(9.0, 0, 0, math.nan)", "InvalidOption"),
    "too far": ("engine().start_at(1e30, 0, 0, 0)", "InvalidOption"),
    "a fleet of nothing": ("_engine.Fleet([None], 1)", "TypeError"),
    "a place of no fleet": ("_engine.Fleet([engine()], 1).check(5)", "IndexError"),
    "to put nothing": ("_engine.Fleet([engine()], 1).put(0, None)", "TypeError"),
    "to put it nowhere": ("_engine.Fleet([engine()], 1).put(5, engine())", "IndexError"),
}  # fmt: skip


class TestCalls:
    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("place", [0, 1, 2])
    def test_controls_that_are_no_numbers(self, bad, place):
        backend = NativeBackend(SMALL)
        backend.reset(np.random.default_rng(0), None)
        controls = [0.0, 0.5, 0.0]
        before = backend.step(Controls(*controls), 5)
        controls[place] = bad
        with pytest.raises(InvalidAction, match="expected finite numbers"):
            backend.engine.step(*controls, None, 5)
        assert backend.engine.read(0)[:23] == before[:23]

    def test_controls_and_gears_out_of_range_do_no_harm(self):
        code = BEGIN + (
            "race = engine(); race.start_at(100, 0, 0, 10)\n"
            "for gear in (-1, 0, 1, 7, 100, -100, 2**31 - 1, -2**31):\n"
            "    for pedal in (1e30, -1e30, 7.0):\n"
            "        state = race.step(pedal, pedal, pedal, gear, 20)\n"
            "print(np.isfinite([*state[:23]]).all())"
        )
        assert python(code).strip() == "True"

    def test_everything_after_close_says_so(self):
        engine = make_engine(find_game(), SMALL, [AGENT])
        engine.start()
        engine.close()
        engine.close()
        calls = [
            engine.start, engine.save, engine.results, engine.track_summary,
            lambda: engine.start_at(0, 0, 0, 0), lambda: engine.step(0, 0, 0, None, 1),
            lambda: engine.advance(1), lambda: engine.read(0), lambda: engine.controls(0),
            lambda: engine.car_name(0), lambda: engine.laps(0), lambda: engine.set_noise(1),
            lambda: engine.set_origin(0, 0), lambda: engine.update_physics(1),
            lambda: engine.replay(np.zeros((1, 3)), True), lambda: engine.agents,
            lambda: engine.ended, lambda: engine.focus(0, 0.0), engine.appearance,
        ]  # fmt: skip
        for call in calls:
            with pytest.raises(EnvClosed, match="closed; make a new environment"):
                call()

    @pytest.mark.parametrize("what", WRONG)
    def test_a_call_that_makes_no_sense(self, what):
        call, error = WRONG[what]
        code = BEGIN + (
            "import faulthandler\n"
            "from sb3_torcs import _engine\n"
            "faulthandler.dump_traceback_later(3, exit=True)\n"
            f"print(raised(lambda: {call}))\n"
            "faulthandler.cancel_dump_traceback_later()"
        )
        assert python(code).strip() == error

    def test_a_moment_of_a_race_that_is_gone(self):
        """The next race may lie at the same address."""
        code = BEGIN + (
            "import faulthandler\n"
            "faulthandler.dump_traceback_later(4, exit=True)\n"
            "gone = engine(); moment = gone.save(); gone.close()\n"
            "for track in ('michigan', 'g-track-1', 'dirt-1'):\n"
            "    race = engine(track); race.start()\n"
            "    print(raised(lambda: race.restore(moment)))\n"
            "    race.advance(50); race.close()\n"
        )
        assert python(code).split() == 3 * ["InvalidOption"]


class TestThreads:
    def test_two_on_one_engine(self):
        """One is told, the other drives on, and the engine is as good as before."""
        engine = make_engine(find_game(), SMALL, [AGENT])
        engine.start()
        told = []

        def drive_once():
            try:
                engine.advance(500)
            except EngineBusy as error:
                told.append(str(error))
                time.sleep(0.001)  # or it is told so twenty times within one drive

        def drive():
            for _ in range(20):
                drive_once()

        workers = [threading.Thread(target=drive) for _ in range(2)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        assert told
        assert all("make one environment per thread" in message for message in told)
        engine.start()
        undisturbed = make_engine(find_game(), SMALL, [AGENT])
        undisturbed.start()
        drives = [race.step(0.0, 1.0, 0.0, None, 50)[:23] for race in (engine, undisturbed)]
        assert drives[0] == drives[1]

    def test_close_does_not_pull_the_race_from_under_another_thread(self):
        code = BEGIN + (
            "import time\n"
            "race = engine(); race.start()\n"
            "worker = threading.Thread(target=race.advance, args=(100_000,)); worker.start()\n"
            "time.sleep(0.05); print(raised(race.close)); worker.join(); race.close()"
        )
        assert python(code).strip() in ("EngineBusy", "nothing")


class TestProcesses:
    @pytest.mark.parametrize("robots", ["", "('bt', 3), "], ids=["alone", "among robots"])
    def test_after_a_fork_each_has_its_own(self, robots):
        """The parent's engine is refused in the child; new ones work in both, and agree."""
        code = BEGIN + (
            f"entries = [{robots}AGENT]; session = 'race' if entries[1:] else 'practice'\n"
            "def drive():\n"
            "    race = engine(entries=entries, session=session)\n"
            "    race.start(); race.advance(100)\n"
            "    return hash(tuple(race.read(0)[:23]))\n"
            "pooled = engine(); pooled.close()\n"
            "old = engine(entries=entries, session=session); old.start()\n"
            "read, write = os.pipe()\n"
            "if os.fork() == 0:\n"
            "    found = [raised(lambda: old.step(0, 0, 0, None, 1)), raised(old.save)]\n"
            "    found += [raised(old.close), drive(), drive()]\n"
            "    os.write(write, json.dumps(found).encode())\n"
            "    del old\n"
            "    os._exit(0)\n"
            "status = os.wait()[1]\n"
            "child = json.loads(os.read(read, 4096))\n"
            "print(json.dumps([status, child, drive(), raised(lambda: old.advance(5))]))"
        )
        status, child, parent, old = json.loads(python(code))
        assert (status, old) == (0, "nothing")
        assert child == ["EngineForked", "EngineForked", "nothing", parent, parent]

    def test_a_child_that_ends_as_python_does(self):
        """With all its destructors, also of what is not its own."""
        code = BEGIN + (
            "old = engine(entries=[('bt', 3), AGENT], session='race'); old.start()\n"
            "child = os.fork()\n"
            "if child == 0: engine().start(); sys.exit(7)\n"
            "print(os.waitpid(child, 0)[1] >> 8); old.advance(10)"
        )
        assert python(code).strip() == "7"

    @pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
    def test_vector_environments(self, method):
        """The parent has an engine of its own, made before the children."""
        own = gym.make("Torcs-v0", track=SMALL)
        own.reset(seed=0)
        vector = make_vec_env(
            "sb3_torcs:Torcs-v0", 2, seed=0, env_kwargs={"track": SMALL},
            vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": method},
        )  # fmt: skip
        try:
            vector.reset()
            action = np.array([0.0, 1.0, 0.0], np.float32)
            for _ in range(10):
                seen = vector.step(np.stack([action, action]))[0]
                expected = own.step(action)[0]
            np.testing.assert_array_equal(seen, np.stack([expected, expected]))
        finally:
            vector.close()


class TestGoodManners:
    def test_nothing_of_the_process_changes(self):
        """Its folder, locale, environment, signals and streams are as before, and quiet."""
        code = BEGIN + (
            "import locale, signal\n"
            "locale.setlocale(locale.LC_ALL, 'C.UTF-8')\n"
            "MASKS = ('SigBlk', 'SigIgn', 'SigCgt')\n"
            "def around():\n"
            "    signals = [signal.getsignal(s) for s in signal.valid_signals()]\n"
            "    status = open('/proc/self/status').read()\n"
            "    blocked = [line for line in status.splitlines() if line[:6] in MASKS]\n"
            "    return (os.getcwd(), locale.setlocale(locale.LC_ALL), dict(os.environ),\n"
            "            signals, blocked, os.umask(0o22))\n"
            "before = around()\n"
            "race = engine(entries=[('inferno', 3), ('olethros', 3), AGENT], session='race')\n"
            "race.start(); race.advance(2000); race.close()\n"
            "raised(lambda: engine('nope'))\n"
            "after = around()\n"
            "print([one == other for one, other in zip(before, after)])"
        )
        assert json.loads(python(code).strip().lower()) == 6 * [True]

    def test_numbers_are_read_with_a_point_whatever_the_locale(self):
        """Where a comma separates digits, strtod would read 3.5 as 3."""
        code = BEGIN + (
            "import locale\n"
            "for name in ('de_DE.UTF-8', 'fr_FR.UTF-8', 'C.UTF-8'):\n"
            "    try: locale.setlocale(locale.LC_ALL, name); break\n"
            "    except locale.Error: continue\n"
            "race = engine(entries=[('bt', 3)]); race.start(); race.advance(500)\n"
            "print(race.track_summary()['length'], race.read(0).distance_raced)"
        )
        engine = make_engine(find_game(), SMALL, [("bt", 3)])
        engine.start()
        engine.advance(500)
        length, raced = map(float, python(code).split())
        assert length == engine.track_summary()["length"]
        assert raced == engine.read(0).distance_raced

    @pytest.mark.skipif(
        "libasan" in os.environ.get("LD_PRELOAD", ""), reason="the sanitizer's own heap grows"
    )
    def test_opening_and_closing_leaves_nothing(self, tmp_path):
        """No file, no descriptor, no mapping, and no more memory than a few races need."""
        code = BEGIN + (
            "def use(): return (len(os.listdir('/proc/self/fd')),\n"
            "                   len(open('/proc/self/maps').readlines()))\n"
            "def rss(): return int(open('/proc/self/statm').read().split()[1]) * 4096 / 2**20\n"
            "def cycle(i):\n"
            "    race = engine(('g-track-1', 'michigan')[i % 2],\n"
            "                  [AGENT, ('bt', 3)][: 1 + i % 3 // 2], laps=1)\n"
            "    race.start(); race.advance(10); race.close()\n"
            "for i in range(12): cycle(i)\n"
            "before, memory = use(), rss()\n"
            "for i in range(200): cycle(i)\n"
            "print(json.dumps([before, use(), rss() - memory, os.listdir(sys.argv[1])]))"
        )
        before, after, grown, files = json.loads(
            python(code, str(tmp_path), cwd=tmp_path, TMPDIR=str(tmp_path), HOME=str(tmp_path))
        )
        assert after[0] == before[0]
        assert after[1] <= before[1] + 5
        assert grown < 5.0
        assert files == []

    def test_robots_write_nothing(self, copy, tmp_path):
        """Some keep what they learned about a track, which would change the next race."""
        root, data, _ = copy
        before = sorted(str(path) for path in data.rglob("*"))
        entries = [["inferno", 3], ["berniw", 3], ["bt", 3], ["olethros", 3], ["tita", 3]]
        assert attempt(root, entries=entries, session="race")[0] == "nothing"
        assert sorted(str(path) for path in data.rglob("*")) == before
