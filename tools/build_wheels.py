"""Build wheels into dist/: one with the engine for each Python that is here, and one without it.

The files that git knows are built, in a folder of their own. A wheel with the engine is named after
the oldest Linux that it runs on, as auditwheel finds; nothing is put into it, since the game loads
two of its libraries itself, by their names.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
HEADERS = "import os, sysconfig; print(os.path.exists(sysconfig.get_path('include') + '/Python.h'))"


def main() -> int:
    """Build all of them."""
    dist = ROOT / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        copy_source(Path(folder, "source"))
        wheels = [build(sys.executable, Path(folder, "source"), Path(folder), engine=False)]
        for python in interpreters():
            source = Path(folder, python.replace("/", "_"))
            copy_source(source)
            wheels.append(named(build(python, source, Path(folder), engine=True)))
        dist.mkdir()
        for wheel in wheels:
            print(f"{shutil.copy(wheel, dist)}: {wheel.stat().st_size / 1e6:.1f} MB")
    return 0


def copy_source(folder: Path) -> None:
    """
    Copy the files that git knows.

    :param folder: for them
    """
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def interpreters() -> list[str]:
    """List the Pythons of this machine that can compile the engine."""
    found = []
    for version in PYTHONS:
        mine = version == f"{sys.version_info.major}.{sys.version_info.minor}"
        python = sys.executable if mine else shutil.which(f"python{version}")
        looked = subprocess.run([python, "-c", HEADERS], capture_output=True) if python else None
        if python and looked and looked.stdout.strip() == b"True":
            found.append(python)
        else:
            print(f"Python {version} or its headers are not here: it gets no wheel", flush=True)
    return found


def build(python: str, source: Path, folder: Path, *, engine: bool) -> Path:
    """
    Build a wheel.

    :param python: that it is for
    :param source: folder of the files
    :param folder: for the wheel
    :param engine: whether it holds the engine
    :return: the wheel
    """
    before = set(folder.glob("*.whl"))
    environment = {**os.environ, "SB3_TORCS_WITHOUT_ENGINE": "0" if engine else "1"}
    words = ["wheel", "--no-deps", "--no-cache-dir", "--verbose", "--wheel-dir", str(folder)]
    if python == sys.executable:
        words.append("--no-build-isolation")  # all that a build needs is here
    else:
        locked = str(ROOT / "constraints.txt")
        environment |= {"PIP_CONSTRAINT": locked, "PIP_BUILD_CONSTRAINT": locked}
    pip = [sys.executable, "-m", "pip", "--python", python]
    subprocess.run([*pip, *words, str(source)], env=environment, check=True)
    (wheel,) = set(folder.glob("*.whl")) - before
    return wheel


def named(wheel: Path) -> Path:
    """
    Name a wheel after the oldest Linux that it runs on.

    :param wheel: as it was built
    :return: the wheel under its new name
    """
    audit = [sys.executable, "-m", "auditwheel", "show", "--json", str(wheel)]
    found = json.loads(subprocess.run(audit, check=True, capture_output=True, text=True).stdout)
    if found["external_libs"]:
        raise SystemExit(f"{wheel.name} needs libraries that not every Linux has: {found}")
    tags = [
        sys.executable,
        "-m",
        "wheel",
        "tags",
        "--remove",
        "--platform-tag",
        found["overall_tag"],
    ]
    done = subprocess.run([*tags, str(wheel)], check=True, capture_output=True, text=True)
    return wheel.parent / done.stdout.split()[-1]


if __name__ == "__main__":
    sys.exit(main())
