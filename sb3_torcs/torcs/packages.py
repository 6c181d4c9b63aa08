"""Getting the game, and a display for its pictures, by the packages of Debian and Ubuntu.

As root apt-get installs them. Without root they are downloaded and unpacked into a folder.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from sb3_torcs.errors import BackendUnavailable, InstallFailed
from sb3_torcs.files import writable_folder
from sb3_torcs.torcs.installation import HOME_VARIABLE, Game, find_game, user_folder

__all__ = ["VIDEO_PACKAGES", "Tell", "install_display", "install_game"]

PACKAGES = ("torcs", "torcs-data")
VIDEO_PACKAGES = ("xvfb", "libgl1-mesa-dri")  # a display without a screen, and what draws on it
LOOK_AGAIN = 0.1  # [s] between two looks at a running program
LAST_LINES = 5  # of what a failed program said
LOCK_PATIENCE = 120  # [s] to wait for another apt

Tell = Callable[[str], None]
"""Shows a line at once: the program that it names may print, too."""

ELSEWHERE = """\
apt-get and dpkg-deb, which this command uses, are not here. Get TORCS 1.3.7 by hand:
  Fedora:  sudo dnf install torcs
  Arch:    build the package `torcs` of the AUR
  others:  from https://torcs.sourceforge.net: ./configure; make; make install; make datainstall
Then type: sb3-torcs doctor
If it went neither to /usr nor to /usr/local, let SB3_TORCS_HOME name the folder first."""


def install_game(absent: BackendUnavailable, tell: Tell, *, for_user: bool) -> Game:
    """
    Install the game in the way that this machine has.

    :param absent: why it has to be
    :param tell: shows which programs run
    :param for_user: whether to leave the system as it is
    :return: what was installed
    :raises InstallFailed: if that cannot be
    """
    if os.environ.get(HOME_VARIABLE):
        raise InstallFailed(
            f"{absent} (an installation elsewhere would not be looked at while {HOME_VARIABLE} is "
            "set)"
        )
    if not all(shutil.which(program) for program in ("apt-get", "apt-cache", "dpkg-deb")):
        raise InstallFailed(ELSEWHERE)
    if for_user:
        return _unpack_for_user(user_folder())
    if not _apt_knows(()):
        _shown(["apt-get", "update"], tell)
    _apt_install(PACKAGES, "sb3-torcs install-torcs --user", tell)
    return find_game()


def install_display(tell: Tell, *, only_look: bool = False) -> Path:
    """
    Install Xvfb, if it is not there.

    :param tell: shows which programs run
    :param only_look: whether to install nothing
    :return: the program
    :raises InstallFailed: if it is not there at the end
    """
    found = shutil.which("Xvfb")
    if found:
        return Path(found)
    by_hand = f"sudo apt-get install {' '.join(VIDEO_PACKAGES)}"
    if only_look or os.geteuid() != 0 or not shutil.which("apt-get"):
        raise InstallFailed(f"Xvfb is not installed, and only root can; type: {by_hand}")
    _apt_install(VIDEO_PACKAGES, by_hand, tell)
    return install_display(tell, only_look=True)


def _apt_install(packages: Sequence[str], otherwise: str, tell: Tell) -> None:
    """
    Install packages, as root.

    :param packages: their names
    :param otherwise: what to type if that fails
    :param tell: shows which programs run
    """
    install = ["apt-get", "install", "--yes", "--no-install-recommends", *packages]
    install += ["-o", f"DPkg::Lock::Timeout={LOCK_PATIENCE}"]
    if _shown(install, tell) != 0:
        # An old list names versions that the server has no more.
        _shown(["apt-get", "update"], tell)
        if _shown(install, tell) != 0:
            raise InstallFailed(
                f"apt-get could not install {packages[0]} (see above); type: {otherwise}"
            )


def _shown(call: Sequence[str], tell: Tell) -> int:
    """Run a program that shows its own progress."""
    tell(f"+ {' '.join(call)}")
    return subprocess.run(
        call, env=_environment(), stdin=subprocess.DEVNULL, check=False
    ).returncode


def _environment() -> dict[str, str]:
    """Make the environment of a program: no questions, and words that can be read."""
    return {**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}


def _output(call: Sequence[str]) -> str:
    """Run a program for what it prints."""
    done = subprocess.run(
        call, env=_environment(), stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    return done.stdout.decode(errors="replace") if done.returncode == 0 else ""


def _apt_knows(options: Sequence[str]) -> bool:
    """Ask apt whether it knows the game."""
    return bool(_output(["apt-cache", *options, "show", "--no-all-versions", *PACKAGES]))


def _unpack_for_user(target: Path) -> Game:
    """
    Download and unpack the game; until all of it is there, the target does not change.

    :param target: folder for it
    :return: what was unpacked
    """
    writable_folder(target.parent)
    with contextlib.ExitStack() as stack:
        staging = Path(tempfile.mkdtemp(prefix=".torcs-", dir=target.parent))
        stack.callback(shutil.rmtree, staging, ignore_errors=True)
        options = _apt_options(staging)
        archives = _download(_wanted(options), options, staging)
        root = staging / "root"
        _unpack(archives, root, staging)
        _verify(find_game(root))
        if target.exists():
            target.rename(staging / "old")
        root.rename(target)
    return find_game()


def _apt_options(staging: Path) -> list[str]:
    """
    Choose options with which apt knows the game, without root.

    :param staging: where it may keep lists of its own, if the system has none
    :return: options for apt
    """
    # Its own user could not write to our folder; as root it would complain about that.
    options = ["-o", f"APT::Sandbox::User={'root' if os.geteuid() == 0 else ''}"]
    if _apt_knows(options):
        return options
    for name in ("lists/partial", "cache/archives/partial"):
        (staging / name).mkdir(parents=True)
    options += ["-o", f"Dir::State::Lists={staging / 'lists'}"]
    options += ["-o", f"Dir::Cache={staging / 'cache'}"]
    with _progress() as progress:
        progress.add_task("reading the lists of packages", total=None)
        _quietly(["apt-get", *options, "update"], staging, lambda: None)
    if not _apt_knows(options):
        raise InstallFailed(
            "apt knows no package `torcs`; on Ubuntu type: sudo add-apt-repository universe"
        )
    return options


def _wanted(options: Sequence[str]) -> list[str]:
    """Find out which packages to get: the game, and what it needs and the system has not."""
    call = ["apt-get", *options, "--simulate", "--no-install-recommends", "install", *PACKAGES]
    words = [line.split() for line in _output(call).splitlines()]
    # With the version it has in brackets, a line is about a package that is there.
    new = [w[1] for w in words if w[:1] == ["Inst"] and not w[2].startswith("[")]
    return [*PACKAGES, *(name for name in new if name not in PACKAGES)]


def _download(packages: Sequence[str], options: Sequence[str], staging: Path) -> list[Path]:
    """
    Download packages; apt checks their signatures.

    :param packages: their names
    :param options: for apt
    :param staging: folder for everything
    :return: the archives
    """
    folder = staging / "archives"
    folder.mkdir()
    uris = _output(["apt-get", *options, "--print-uris", "download", *packages]).splitlines()
    sizes = [int(words[2]) for words in map(str.split, uris) if len(words) > 2]
    with _progress() as progress:
        task = progress.add_task(f"downloading {len(packages)} packages", total=sum(sizes) or None)

        def look() -> None:
            got = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
            progress.update(task, completed=got)

        _quietly(["apt-get", *options, "download", *packages], folder, look)
        look()
    return sorted(folder.glob("*.deb"))


def _unpack(archives: Sequence[Path], root: Path, staging: Path) -> None:
    """
    Unpack archives, and remove each as soon as it is unpacked.

    :param archives: to unpack
    :param root: to unpack into
    :param staging: where programs run
    """
    root.mkdir()
    with _progress() as progress:
        task = progress.add_task("unpacking", total=sum(p.stat().st_size for p in archives))
        for archive in archives:
            size = archive.stat().st_size
            _quietly(["dpkg-deb", "--extract", str(archive), str(root)], staging, lambda: None)
            archive.unlink()
            progress.advance(task, size)


def _verify(game: Game) -> None:
    """
    Make sure that what was unpacked runs here.

    :param game: the installation
    """
    from sb3_torcs.torcs.libraries import missing_libraries

    missing = missing_libraries(game)
    if missing:
        raise InstallFailed(
            f"the unpacked game would not find {', '.join(missing)}; with root type: "
            "sudo apt-get install torcs"
        )


def _quietly(call: Sequence[str], folder: Path, look: Callable[[], None]) -> None:
    """
    Run a program whose words matter only if it fails; it ends when we are interrupted.

    :param call: program and arguments
    :param folder: to run in
    :param look: called again and again
    :raises InstallFailed: with its last words
    """
    with tempfile.TemporaryFile() as words:
        process = subprocess.Popen(
            call, cwd=folder, env=_environment(),
            stdin=subprocess.DEVNULL, stdout=words, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            while process.poll() is None:
                look()
                time.sleep(LOOK_AGAIN)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        if process.returncode != 0:
            raise InstallFailed(f"`{call[0]}` failed: {_last_words(words)}; nothing was changed")


def _last_words(words: IO[bytes]) -> str:
    """Read the end of what a program printed."""
    words.seek(0)
    lines = words.read().decode(errors="replace").splitlines()
    return " / ".join([line.strip() for line in lines if line.strip()][-LAST_LINES:]) or "no words"


@contextlib.contextmanager
def _progress() -> Iterator[Any]:
    """Show progress on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:
        yield progress
