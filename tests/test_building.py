"""An engine that is missing is told when it goes missing, with a remedy that is there."""

import json
import os
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


GONE = {"url": "file:///is/gone", "dir_info": {}}


@pytest.mark.parametrize("record", [None, "", "{", GONE, {"url": "file:///x.whl"}])
def test_the_remedy_names_a_checkout_where_none_is_known(monkeypatch, record):
    installed_from(monkeypatch, record)
    assert "--no-deps . (in a checkout of sb3-torcs) (it needs" in build_command()


def build(folder, **environment):
    """Build the extensions as an installation does, somewhere else."""
    folders = ["--build-lib", folder, "--build-temp", folder]
    command = [sys.executable, "setup.py", "build_ext", *folders]
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
