"""What one installs from a wheel: all of it, on every Linux that its name allows, and drives."""

from __future__ import annotations

import configparser
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from email import message_from_string
from importlib import metadata
from pathlib import Path

import pytest
import yaml

import sb3_torcs

ROOT = Path(__file__).parent.parent
SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg")
EXTRAS = SETUP["options.extras_require"]
IMPORTED_AS = {"imageio-ffmpeg": "imageio_ffmpeg", "sb3-contrib": "sb3_contrib", "sbx-rl": "sbx"}
BROUGHT_BY_THE_CORE = {"pandas", "pillow"}  # by highway-env
LIBRARIES = {"_engine", "_game_maths", "_game_window", "_scr_server"}


def load_builder():
    spec = importlib.util.spec_from_file_location("build_wheels", ROOT / "tools/build_wheels.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


builder = load_builder()


@pytest.fixture(scope="module")
def pure_wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pure")
    builder.copy_source(folder / "source")
    return builder.build(sys.executable, folder / "source", folder, engine=False)


@pytest.fixture(scope="module")
def engine_wheel(tmp_path_factory):
    """
    As ``make wheels`` builds it, but for the compiler: setuptools finds this checkout's libraries,
    newer than their sources, where it would put its own.
    """
    folder = tmp_path_factory.mktemp("engine")
    builder.copy_source(folder / "source")
    build = f"lib.{sysconfig.get_platform()}-{sys.implementation.cache_tag}"
    compiled = folder / "source" / "build" / build / "sb3_torcs"
    compiled.mkdir(parents=True)
    for library in (ROOT / "sb3_torcs").glob(f"*{sysconfig.get_config_var('EXT_SUFFIX')}"):
        shutil.copy(library, compiled)
    return builder.named(builder.build(sys.executable, folder / "source", folder, engine=True))


def installed(wheel, folder):
    """A fresh environment with the wheel in it, and this one's libraries after it."""
    venv.create(folder)
    python = folder / "bin" / "python"
    words = ["install", "--no-deps", "--no-index", str(wheel)]
    pip = [sys.executable, "-m", "pip", "--python", str(python), *words]
    subprocess.run(pip, check=True, capture_output=True)
    (site,) = folder.glob("lib/*/site-packages")
    # A path of a .pth file is searched, but the .pth files there are not read.
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))
    return python


def run(python, code, folder, *words):
    call = [python, "-c", code, *words]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def names(wheel):
    return zipfile.ZipFile(wheel).namelist()


def described(wheel):
    (name,) = [name for name in names(wheel) if name.endswith(".dist-info/METADATA")]
    return message_from_string(zipfile.ZipFile(wheel).read(name).decode())


def wanted():
    """What a wheel holds: every module, and each data file that setup.cfg names."""
    packages = SETUP["options"]["packages"].split()
    folders = {name: ROOT / name.replace(".", "/") for name in packages}
    folders["sb3_torcs.zoo_configs"] = ROOT / "zoo_configs"
    data = {"sb3_torcs": SETUP["options.package_data"]["sb3_torcs"].split(", ")}
    data["sb3_torcs.zoo_configs"] = ["*.yml"]
    return {
        f"{name.replace('.', '/')}/{path.relative_to(folder)}"
        for name, folder in folders.items()
        for pattern in ("*.py", "*.pyi", *data.get(name, ()))
        for path in folder.glob(pattern)
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_the_pure_wheel_is_for_every_machine_and_holds_no_library(pure_wheel):
    assert pure_wheel.name == f"sb3_torcs-{sb3_torcs.__version__}-py3-none-any.whl"
    held = {name for name in names(pure_wheel) if ".dist-info/" not in name}
    assert held == wanted()


def test_the_wheel_with_the_engine_is_named_after_the_oldest_linux(engine_wheel):
    python = sys.implementation.cache_tag.replace("cpython-", "cp")
    start = rf"sb3_torcs-{re.escape(sb3_torcs.__version__)}-{python}-{python}-"
    assert re.fullmatch(rf"{start}manylinux_2_\d+_{os.uname().machine}\.whl", engine_wheel.name)


def test_the_wheel_with_the_engine_holds_the_three_libraries_and_none_of_others(engine_wheel):
    held = {name for name in names(engine_wheel) if ".dist-info/" not in name}
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    libraries = {f"sb3_torcs/{name}{suffix}" for name in LIBRARIES}
    assert held == wanted() | libraries
    with zipfile.ZipFile(engine_wheel) as archive:
        for name in libraries:
            assert archive.read(name) == (ROOT / name).read_bytes(), "not built here: make native"


def test_a_wheel_says_what_it_is(pure_wheel):
    described_as = described(pure_wheel)
    assert described_as["Version"] == sb3_torcs.__version__
    assert described_as["License"] == "GPL-2.0-or-later"
    assert described_as["Requires-Python"] == ">=3.11"
    assert described_as.get_all("Provides-Extra") == list(EXTRAS)
    core = [line for line in described_as.get_all("Requires-Dist") if "extra ==" not in line]
    assert len(core) <= 14


DRIVE = """
import sys
import gymnasium as gym, sb3_torcs
assert sb3_torcs.__file__.startswith(sys.prefix), sb3_torcs.__file__
env = gym.make("sb3_torcs:Torcs-v0", track="aalborg")
env.reset(seed=0)
for _ in range(20):
    info = env.step([0.1, 1.0, 0.0])[-1]
print(repr(info["car"].x), repr(info["car"].speed_x))
"""
HERE = DRIVE.replace("assert", "0 and")


def test_the_wheel_with_the_engine_drives_the_game_as_a_build_here_does(engine_wheel, tmp_path):
    python = installed(engine_wheel, tmp_path / "fresh")
    assert run(python, DRIVE, tmp_path) == run(sys.executable, HERE, ROOT)


LEARN = """
import sys
import gymnasium as gym, sb3_torcs
from stable_baselines3 import PPO
assert sb3_torcs.__file__.startswith(sys.prefix), sb3_torcs.__file__
model = PPO("MlpPolicy", gym.make("TorcsLite-v0"), n_steps=128, device="cpu", seed=0).learn(128)
print(model.num_timesteps)
try:
    gym.make("Torcs-v0")
except sb3_torcs.errors.BackendUnavailable as error:
    print(error)
"""


def test_the_pure_wheel_learns_on_lite_and_says_what_torcs_lacks(pure_wheel, tmp_path):
    python = installed(pure_wheel, tmp_path / "fresh")
    timesteps, lacks = run(python, LEARN, tmp_path).splitlines()[:2]
    assert timesteps == "128"
    assert "pip install" in lacks, lacks


WITHOUT_EXTRAS = """
import importlib, pkgutil, sys
sys.modules.update(dict.fromkeys(sys.argv[1:]))  # each import of one of them fails
import sb3_torcs
needing = []
for module in pkgutil.walk_packages(sb3_torcs.__path__, "sb3_torcs."):
    try:
        module.name.endswith("__main__") or importlib.import_module(module.name)
    except ImportError:
        needing.append(module.name)
print(*needing)
from sb3_torcs.agents.models import find_model
from sb3_torcs.tracks import load_track
print(load_track("aalborg").name, find_model("ddpg-fallback").name)
assert sb3_torcs.__file__.startswith(sys.prefix), sb3_torcs.__file__
sys.argv = ["sb3-torcs", "--help"]
from sb3_torcs.cli import main
main()
"""

ONLY_OF_AN_EXTRA = ["sb3_torcs.envs.parallel_env", "sb3_torcs.rendering.encoder"]


def extras():
    """The modules that only an extra brings to users."""
    lines = "\n".join(EXTRAS[name] for name in EXTRAS if name not in ("all", "tests"))
    found = set(re.findall(r"^[\w-]+", lines, re.MULTILINE)) - {"sb3-torcs", *BROUGHT_BY_THE_CORE}
    return sorted(IMPORTED_AS.get(name, name) for name in found)


def test_a_wheel_is_whole_and_works_without_any_extra(pure_wheel, tmp_path):
    """Every module, the shipped files and the command: only who uses an extra needs it."""
    assert set(extras()) >= {"onnx", "ray", "rl_zoo3", "imageio_ffmpeg"}
    python = installed(pure_wheel, tmp_path / "fresh")
    shown = run(python, WITHOUT_EXTRAS, tmp_path, *extras())
    needing, rest = shown.split("\n", 1)
    assert needing.split() == ONLY_OF_AN_EXTRA
    assert rest.startswith("aalborg best_model.zip\nusage: sb3-torcs")


def test_the_version_is_one():
    version = sb3_torcs.__version__
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == version
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert metadata.version("sb3-torcs") == version

    def tags(*words):
        call = ["git", "tag", "--list", "v*", *words]
        done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True)
        return set(done.stdout.split())  # none in a folder that is no checkout

    assert tags() <= {f"v{heading}" for heading in headings}
    assert tags("--points-at", "HEAD") <= {f"v{version}"}
