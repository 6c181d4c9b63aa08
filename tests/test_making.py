"""The programs behind ``make``, with stand-ins for apt, sudo and Python: nothing is installed."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
TOOLS = ROOT / "tools"
SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg")
REAL = ("basename", "bash", "env", "mktemp", "nice", "rm", "cat", "timeout")
NVIDIA = Path("/proc/driver/nvidia/version").exists()


class Machine:
    """A machine whose programs are all ours."""

    def __init__(self, folder):
        self.bin = folder / "bin"
        self.bin.mkdir()
        self.log = folder / "log"
        self.log.touch()
        for name in REAL:
            (self.bin / name).symlink_to(shutil.which(name))

    def add(self, name, code="exit 0"):
        """Write a program that writes down how it was called."""
        program = self.bin / name
        program.write_text(f'#!/bin/bash\necho "{name} $*" >>{self.log}\n{code}\n')
        program.chmod(0o755)
        return program

    def run(self, *call, **settings):
        environment = {"PATH": str(self.bin), **settings}
        call = [str(TOOLS / call[0]), *call[1:]]
        done = subprocess.run(call, env=environment, cwd=ROOT, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr

    def calls(self, name):
        return [line for line in self.log.read_text().splitlines() if line.startswith(name)]


@pytest.fixture
def machine(tmp_path):
    """Debian with Python and its headers, no compiler, for root; apt installs what it is asked."""
    machine = Machine(tmp_path)
    machine.add("id", "echo 0")
    machine.add("python3")
    machine.add("apt-cache")
    machine.add(
        "apt-get", f"[[ $* != *install*g++* ]] || cp {machine.bin}/python3 {machine.bin}/c++"
    )
    (machine.bin / "cp").symlink_to(shutil.which("cp"))
    return machine


INSTALL = "apt-get -o DPkg::Lock::Timeout=120 install --yes --no-install-recommends g++"
UPDATE = "apt-get -o DPkg::Lock::Timeout=120 update"


def test_packages_that_are_here_are_not_asked_for(machine):
    assert machine.run("get-packages", "python") == (0, "")
    assert machine.calls("apt") == []


def test_what_is_missing_is_shown_with_its_reason_and_installed(machine):
    status, shown = machine.run("get-packages", "python", "engine")
    assert status == 0
    first, second = shown.splitlines()[:2]
    assert first == "This machine lacks packages:"
    assert second.split(maxsplit=1) == ["g++", "compiles the engine of Torcs-v0"]
    assert machine.calls("apt-get") == [INSTALL]
    assert machine.run("get-packages", "python", "engine") == (0, "")


def test_a_machine_without_lists_of_packages_gets_them_first(machine):
    machine.add("apt-cache", "exit 100")
    assert machine.run("get-packages", "engine")[0] == 0
    assert machine.calls("apt-get") == [UPDATE, INSTALL]


def test_a_user_installs_through_sudo(machine):
    machine.add("id", "echo 1000")
    machine.add("sudo", '"$@"')
    status, shown = machine.run("get-packages", "engine")
    assert status == 0
    assert "sudo may ask for your password" in shown
    assert machine.calls("sudo") == [f"sudo env DEBIAN_FRONTEND=noninteractive {INSTALL}"]


def test_where_nothing_can_be_installed_the_line_to_type_is_shown(machine):
    machine.add("id", "echo 1000")
    status, shown = machine.run("get-packages", "engine")
    assert (status, machine.calls("apt-get")) == (1, [])
    line = "apt-get install --no-install-recommends g++"
    assert shown.endswith(f"Only root can install them; as root type: {line}\n")
    machine.add("sudo", "exit 1")
    status, shown = machine.run("get-packages", "engine")
    assert (status, machine.calls("apt-get")) == (1, [])
    assert shown.endswith(f"They could not be installed (see above); type: sudo {line}\n")


def test_a_system_without_apt_gets_the_names(machine):
    (machine.bin / "apt-get").unlink()
    status, shown = machine.run("get-packages", "engine")
    assert status == 1
    assert "There is no apt-get here: install what these packages of Debian hold" in shown


def test_another_python_has_packages_of_its_own(machine):
    machine.add("apt-get", "exit 100")
    status, shown = machine.run("get-packages", "python", PYTHON="/usr/bin/python3.12")
    assert status == 1
    assert shown.endswith("python3.12 python3.12-venv\n")


@pytest.fixture
def pythons(machine):
    """A Python whose environments write down how they are called, far from any network."""
    python = machine.add("inner", '[[ "$*" != *"${FAILS:-nothing}"* && $* != *urlopen* ]]')
    machine.add("python3", f"[[ $2 != venv ]] || {{ mkdir -p $3/bin; cp {python} $3/bin/python; }}")
    (machine.bin / "mkdir").symlink_to(shutil.which("mkdir"))
    return machine


LOCKED = "--constraint constraints.txt"


def installs(machine):
    return [line for line in machine.calls("inner") if " install " in line]


def test_an_environment_is_made_by_uv_in_the_locked_versions(pythons, tmp_path):
    assert pythons.run("make-environment", str(tmp_path / "v"), FAILS="import torch")[0] == 0
    uv = f"inner -m uv pip install --python {tmp_path}/v/bin/python"
    assert installs(pythons) == [
        f"inner -m pip install {LOCKED} uv",
        f"{uv} {LOCKED} --editable .[tests]",
    ]


@pytest.mark.parametrize("fails", [f"{LOCKED} uv", "-m uv"])
def test_pip_makes_it_where_uv_cannot(pythons, tmp_path, fails):
    status, shown = pythons.run("make-environment", str(tmp_path / "v"), FAILS=fails)
    assert status == 0
    assert "== uv cannot be had: pip" in shown or "== uv has failed: pip" in shown
    assert installs(pythons)[-1] == f"inner -m pip install {LOCKED} --editable .[tests]"


def test_versions_are_the_newest_or_the_oldest_if_one_says_so(pythons, tmp_path):
    for versions, options in (("newest", ""), ("oldest", "--resolution lowest-direct ")):
        assert pythons.run("make-environment", str(tmp_path / "v"), VERSIONS=versions)[0] == 0
        assert installs(pythons)[-1].endswith(f"/bin/python {options}--editable .[tests]")


@pytest.mark.skipif(NVIDIA, reason="for machines without an NVIDIA driver")
def test_without_an_nvidia_driver_pytorch_is_the_build_for_the_processor(pythons, tmp_path):
    pythons.add("inner", '[[ $* != "-c import torch" ]]')
    index = {"TORCH_ON_CPU": "https://torch"}
    assert pythons.run("make-environment", str(tmp_path / "v"), **index)[0] == 0
    (tmp_path / "v/bin/python").write_text((pythons.bin / "inner").read_text())
    assert pythons.run("make-environment", str(tmp_path / "v"), **index)[0] == 0
    assert any(
        line.endswith(f"{LOCKED} --no-deps --index-url https://torch torch")
        for line in installs(pythons)
    )
    pythons.log.write_text("")
    pythons.add("nvidia-smi")
    assert pythons.run("make-environment", str(tmp_path / "v"), **index)[0] == 0
    assert not any("--index-url" in line for line in installs(pythons))


def test_a_python_that_is_too_old_is_refused(pythons, tmp_path):
    pythons.add("python3", '[[ $1 == --version ]] && echo "Python 3.9.2"')
    status, shown = pythons.run("make-environment", str(tmp_path / "v"))
    assert (status, shown) == (
        1, "Python 3.9.2 is here, 3.11 or newer is needed; try: make PYTHON=python3.12\n",
    )  # fmt: skip


def test_checks_run_beside_a_command_and_show_what_they_printed_if_they_fail(machine):
    assert machine.run("run-beside", "echo one", "echo two", "--", "bash", "-c", "echo own") == (
        0, "own\n== echo one: all is well\n== echo two: all is well\n",
    )  # fmt: skip
    assert machine.run("run-beside", "echo why; exit 3", "--", "bash", "-c", "echo own") == (
        1, "own\n== echo why; exit 3: failed\nwhy\n",
    )  # fmt: skip
    assert machine.run("run-beside", "exit 0", "--", "bash", "-c", "exit 5")[0] == 5


def pins(python):
    """The locked versions for a Python on Linux."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    read = [Requirement(line) for line in lines if not line.startswith("#")]
    world = {
        "python_version": python, "python_full_version": f"{python}.1", "sys_platform": "linux",
        "platform_system": "Linux", "platform_machine": "x86_64", "implementation_name": "cpython",
        "platform_python_implementation": "CPython", "os_name": "posix", "extra": "",
    }  # fmt: skip
    return {
        read.name.lower().replace("_", "-"): str(read.specifier).removeprefix("==")
        for read in read
        if read.marker is None or read.marker.evaluate(world)
    }


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13", "3.14"])
def test_each_requirement_is_locked_in_a_version_that_it_allows(python):
    locked = pins(python)
    lists = [SETUP["options"]["install_requires"], *SETUP["options.extras_require"].values()]
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    wanted = [Requirement(line) for line in [*"\n".join(lists).splitlines(), *build]
              if line and not line.startswith(("#", "sb3-torcs"))]  # fmt: skip
    missed = {
        str(one): locked.get(one.name.lower().replace("_", "-"), "none")
        for one in wanted
        if not one.specifier.contains(locked.get(one.name.lower().replace("_", "-"), "0"))
    }
    assert missed == {}


def test_the_locked_versions_name_no_server_and_no_folder():
    text = (ROOT / "constraints.txt").read_text()
    assert not re.search(r"[/@]|^-", text, re.MULTILINE)


def test_ci_runs_the_command_of_the_readme():
    assert (ROOT / ".ci/run").read_text().endswith("exec make test\n")
    assert os.access(ROOT / ".ci/run", os.X_OK)
