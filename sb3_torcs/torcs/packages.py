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
from sb3_torcs.signals import defer_signals
from sb3_torcs.torcs.installation import HOME_VARIABLE, Game, find_game, user_folder

__all__ = ["VIDEO_PACKAGES", "Tell", "install_display", "install_game"]

PACKAGES = ("torcs", "torcs-data")
VIDEO_PACKAGES = ("xvfb", "libgl1-mesa-dri")  # a virtual display, and OpenGL for it
LOOK_AGAIN = 0.1  # [s] between two looks at a running program
LAST_LINES = 5  # shown of the output of a program that failed
LOCK_PATIENCE = 120  # [s] to wait for another apt

Tell = Callable[[str], None]
"""Shows a line at once: the program that it names may print, too."""

ELSEWHERE = """\
this command needs apt-get and dpkg-deb, which are missing. Install TORCS 1.3.7 by hand:
  Fedora:  sudo dnf install torcs
  Arch:    build the package `torcs` of the AUR
  others:  from https://torcs.sourceforge.net: ./configure; make; make install; make datainstall
Then type: sb3-torcs doctor
If it is neither in /usr nor in /usr/local, set SB3_TORCS_HOME to its folder first."""


def install_game(absent: BackendUnavailable, tell: Tell, *, for_user: bool) -> Game:
    """
    Install the game in the way that this machine has.

    :param absent: the error of not finding the game
    :param tell: shows which programs run
    :param for_user: whether to leave the system as it is
    :return: what was installed
    :raises InstallFailed: if that cannot be
    """
    if os.environ.get(HOME_VARIABLE):
        raise InstallFailed(
            f"{absent} (no other folder is looked at while {HOME_VARIABLE} is set; unset it, "
            "or correct it)"
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
    Install Xvfb, if it is missing.

    :param tell: shows which programs run
    :param only_look: whether to install nothing
    :return: the program
    :raises InstallFailed: if it is missing at the end
    """
    found = shutil.which("Xvfb")
    if found:
        return Path(found)
    by_hand = f"sudo apt-get install {' '.join(VIDEO_PACKAGES)}"
    if only_look or os.geteuid() != 0 or not shutil.which("apt-get"):
        raise InstallFailed(f"Xvfb is not installed, and only root can install it; type: {by_hand}")
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
        # Outdated package lists name versions that the server no longer has.
        _shown(["apt-get", "update"], tell)
        if _shown(install, tell) != 0:
            raise InstallFailed(
                f"apt-get could not install {packages[0]} (see above); type: {otherwise}"
            )


def _shown(call: Sequence[str], tell: Tell) -> int:
    """Run a program and let it print."""
    tell(f"+ {' '.join(call)}")
    return subprocess.run(
        call, env=_environment(), stdin=subprocess.DEVNULL, check=False
    ).returncode


def _environment() -> dict[str, str]:
    """Return the environment variables of a program: no questions, English output."""
    return {**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}


def _output(call: Sequence[str]) -> str:
    """Run a program and return its output, which is empty if it fails."""
    done = subprocess.run(
        call, env=_environment(), stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    return done.stdout.decode(errors="replace") if done.returncode == 0 else ""


def _apt_knows(options: Sequence[str]) -> bool:
    """Ask apt whether it knows the game."""
    return bool(_output(["apt-cache", *options, "show", "--no-all-versions", *PACKAGES]))


def _unpack_for_user(target: Path) -> Game:
    """
    Download and unpack the game. The target only changes when everything is complete.

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
        with defer_signals():  # Ctrl-C in between would leave no game
            _replace(target, root, staging / "old")
    return find_game()


def _replace(target: Path, root: Path, old: Path) -> None:
    """
    Put a folder in the place of another, which stays there if that fails.

    :param target: the place
    :param root: the folder
    :param old: where the one before goes
    """
    if target.exists():
        target.rename(old)
    try:
        root.rename(target)
    except OSError:
        if old.exists():
            old.rename(target)
        raise


def _apt_options(staging: Path) -> list[str]:
    """
    Choose options with which apt finds the game without root.

    :param staging: a folder for package lists, if the system has none
    :return: options for apt
    """
    # apt's own user cannot write to our folder, and apt warns about that when it runs as root.
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
    """List the packages to download: the game's, and those that it needs and the system lacks."""
    call = ["apt-get", *options, "--simulate", "--no-install-recommends", "install", *PACKAGES]
    words = [line.split() for line in _output(call).splitlines()]
    # A line with a version in brackets is about an installed package.
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
    Make sure that the unpacked game runs.

    :param game: the installation
    """
    from sb3_torcs.torcs.libraries import missing_libraries

    missing = missing_libraries(game)
    if missing:
        raise InstallFailed(
            f"the unpacked game lacks {', '.join(missing)}; with root type: "
            "sudo apt-get install torcs"
        )


def _quietly(call: Sequence[str], folder: Path, look: Callable[[], None]) -> None:
    """
    Run a program, and show its output only if it fails. Ctrl-C ends it, too.

    :param call: program and arguments
    :param folder: to run in
    :param look: called again and again
    :raises InstallFailed: with the end of its output
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
