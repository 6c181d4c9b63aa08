"""An engine that is missing is told when it goes missing, with a remedy that is there."""

import configparser
import json
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from sb3_torcs.torcs.building import build_command

ROOT = Path(__file__).parent.parent


def installed_from(monkeypatch, record):
    text = record if record is None or isinstance(record, str) else json.dumps(record)

    class Distribution:
        def read_text(self, name):
            assert name == "direct_url.json"
            return text

    monkeypatch.setattr(metadata, "distribution", lambda name: Distribution())


def pip_installs(*words):
    command = [sys.executable, "-m", "pip", "install", "--force-reinstall", "--no-deps", *words]
    return f"{' '.join(command)} (it needs a C++17 compiler: sudo apt install g++ python3-dev)"


def test_the_remedy_installs_from_where_the_package_came_from(monkeypatch, tmp_path):
    url = tmp_path.as_uri()
    installed_from(monkeypatch, {"url": url, "dir_info": {}})
    assert build_command() == pip_installs(str(tmp_path))
    installed_from(monkeypatch, {"url": url, "dir_info": {"editable": True}})
    assert build_command() == pip_installs("--editable", str(tmp_path))
    vcs = {"url": "https://x.org/y.git", "vcs_info": {"vcs": "git", "commit_id": "a"}}
    installed_from(monkeypatch, vcs)
    assert build_command() == pip_installs("git+https://x.org/y.git")


@pytest.mark.parametrize(
    "record", [None, "", "{", {"url": "file:///is/gone", "dir_info": {}}, {"url": "file:///x.whl"}]
)
def test_the_remedy_names_a_checkout_where_none_is_known(monkeypatch, record):
    installed_from(monkeypatch, record)
    assert "--no-deps . (in a checkout of sb3-torcs) (it needs" in build_command()


def build(folder, **environment):
    """Build the extensions as an installation does, somewhere else."""
    command = [
        sys.executable,
        "setup.py",
        "build_ext",
        "--build-lib",
        folder,
        "--build-temp",
        folder,
    ]
    settings = {**os.environ, "CC": "/bin/false", "CXX": "/bin/false", **environment}
    return subprocess.run(command, cwd=ROOT, env=settings, capture_output=True, text=True)


def test_an_installation_without_a_compiler_says_that_the_engine_is_missing(tmp_path):
    done = build(str(tmp_path))
    assert done.returncode != 0
    assert "The engine of sb3-torcs, which drives Torcs-v0, cannot be built" in done.stderr
    assert "SB3_TORCS_WITHOUT_ENGINE=1 pip install ." in done.stderr


def test_an_installation_goes_without_the_engine_if_one_says_so(tmp_path):
    done = build(str(tmp_path), SB3_TORCS_WITHOUT_ENGINE="1")
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.rglob("*.so")) == []


def extras():
    """The libraries that only an extra brings to users."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    listed = setup["options.extras_require"]
    lines = "\n".join(listed[name] for name in listed if name != "tests")
    return re.findall(r"^\w+", lines, re.MULTILINE)


@pytest.fixture(scope="module")
def unpacked_wheel(tmp_path_factory):
    """A wheel of what is versioned here, without the engine, unpacked."""
    folder = tmp_path_factory.mktemp("wheel")
    built = shutil.ignore_patterns("*.so", "__pycache__")
    for name in ("sb3_torcs", "zoo_configs"):
        shutil.copytree(ROOT / name, folder / "source" / name, ignore=built)
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / "source")
    words = ["wheel", ".", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    subprocess.run(
        [sys.executable, "-m", "pip", *words],
        cwd=folder / "source",
        env={**os.environ, "SB3_TORCS_WITHOUT_ENGINE": "1"},
        check=True,
        capture_output=True,
    )
    (wheel,) = folder.glob("*.whl")
    shutil.unpack_archive(wheel, folder / "site", "zip")
    return folder / "site"


WITHOUT_EXTRAS = """
import importlib, pkgutil, sys
sys.modules.update(dict.fromkeys(sys.argv[2:]))  # each import of one of them fails
import sb3_torcs
for module in pkgutil.walk_packages(sb3_torcs.__path__, "sb3_torcs."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from sb3_torcs.agents.models import find_model
from sb3_torcs.tracks import load_track
from sb3_torcs.training.zoo import config_file, read_entry
print(load_track("aalborg").name, find_model("ddpg-fallback").name)
assert read_entry(config_file("ddpg"), "TorcsLite-v0")
assert sb3_torcs.__file__.startswith(sys.argv[1]), sb3_torcs.__file__
sys.argv = ["sb3-torcs", "--help"]
from sb3_torcs.cli import main
main()
"""


def test_a_wheel_is_whole_and_works_without_any_extra(unpacked_wheel):
    """Every module, the shipped files and the command: only who uses an extra needs it."""
    assert set(extras()) >= {"onnx", "ray"}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS, str(unpacked_wheel), *extras()],
        cwd=unpacked_wheel,
        env={**os.environ, "PYTHONPATH": str(unpacked_wheel)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("aalborg best_model.zip\nusage: sb3-torcs")
