"""``sb3-torcs install-torcs`` with stand-ins for apt and dpkg: nothing is really installed."""

from __future__ import annotations

import os

import pytest
from fake_game import write_game, write_program

from sb3_torcs.cli import main
from sb3_torcs.torcs import installation as game_module

COMMON = """
import os, pathlib, shutil, signal, sys
folder = pathlib.Path(os.environ["FAKES"])
args = sys.argv[1:]
with (folder / "log").open("a") as log:
    print(os.path.basename(sys.argv[0]), *args, file=log)
def flag(name):
    return (folder / name).exists()
def fail(name):
    if flag(name):
        print("E:", name, "as told", file=sys.stderr)
        sys.exit(100)
"""
APT_GET = """
if "update" in args:
    fail("no-network")
    (folder / "known").touch()
elif "--simulate" in args:
    print("Inst plib-new (1 Debian:12)\\nInst libc6 [1] (2 Debian:12)\\nInst torcs (1 Debian:12)")
    print("Conf torcs (1)")
elif "--print-uris" in args:
    print("'http://host/torcs.deb' torcs.deb 8 SHA256:0")
elif "download" in args:
    fail("no-download")
    for name in args[args.index("download") + 1:]:
        pathlib.Path(f"{name}_1.deb").write_text("12345678")
elif "install" in args:
    fail("no-install") if flag("known") else sys.exit(100)
    if "xvfb" in args:
        (folder / "bin" / "Xvfb").symlink_to(sys.argv[0])
    else:
        shutil.copytree(folder / "game", os.environ["SYSTEM"])
"""
APT_CACHE = """
print("Package: torcs") if flag("known") else sys.exit(100)
"""
DPKG_DEB = """
_, archive, root = args
fail("disk-full")
if flag("interrupt"):
    os.kill(os.getppid(), signal.SIGINT)
if pathlib.Path(archive).name == "torcs_1.deb":
    shutil.copytree(folder / "game", pathlib.Path(root) / "usr")
"""


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine without a game, whose apt and dpkg are ours: no real one can be reached."""
    fakes = tmp_path / "fakes"
    for name, code in (("apt-get", APT_GET), ("apt-cache", APT_CACHE), ("dpkg-deb", DPKG_DEB)):
        write_program(fakes / "bin" / name, COMMON + code)
    write_game(fakes / "game")
    (fakes / "known").touch()
    monkeypatch.setenv("PATH", str(fakes / "bin"))
    monkeypatch.setenv("FAKES", str(fakes))
    monkeypatch.setenv("SYSTEM", str(tmp_path / "usr"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.delenv("SB3_TORCS_HOME", raising=False)
    monkeypatch.setattr(game_module, "SYSTEM_ROOTS", (tmp_path / "usr",))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    return fakes


@pytest.fixture
def own(tmp_path):
    return tmp_path / "data" / "sb3-torcs"


@pytest.fixture
def root(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 0)


def log(machine):
    return (machine / "log").read_text().splitlines() if (machine / "log").exists() else []


def test_a_game_that_is_there_is_named_and_left_alone(machine, tmp_path, capsys):
    write_game(tmp_path / "usr")
    for words in ([], ["--check"], ["--user"]):
        assert main(["install-torcs", *words]) == 0
        assert f"TORCS is installed: data in {tmp_path}/usr/share" in capsys.readouterr().out
    assert log(machine) == []


def test_a_check_installs_nothing(machine, capsys):
    assert main(["install-torcs", "--check"]) == 1
    assert capsys.readouterr().err.startswith("sb3-torcs: TORCS is not installed, neither in")
    assert log(machine) == []


def test_without_root_the_packages_are_unpacked(machine, own, capsys):
    assert main(["install-torcs"]) == 0
    assert f"data in {own}/torcs/usr/share/games/torcs" in capsys.readouterr().out
    assert [path.name for path in own.iterdir()] == ["torcs"]
    (download,) = [line for line in log(machine) if " download " in line and "uris" not in line]
    # What the system has in an older version, such as libc, is not doubled.
    assert download.endswith(" download torcs torcs-data plib-new")
    assert not any(line.startswith("apt-get install") for line in log(machine))
    assert main(["install-torcs"]) == 0
    assert len([line for line in log(machine) if line.startswith("dpkg-deb")]) == 3


def test_with_root_apt_installs(machine, root, own, tmp_path, capsys):
    assert main(["install-torcs"]) == 0
    assert f"data in {tmp_path}/usr/share/games/torcs" in capsys.readouterr().out
    (install,) = [line for line in log(machine) if line.startswith("apt-get")]
    assert install.startswith("apt-get install --yes --no-install-recommends torcs torcs-data")
    assert not own.exists()


def test_video_gets_a_display_too_and_only_once(machine, root, capsys):
    for _ in range(2):
        assert main(["install-torcs", "--video"]) == 0
        assert f"Xvfb is installed: {machine}/bin/Xvfb" in capsys.readouterr().out
    game, display = [line for line in log(machine) if line.startswith("apt-get install")]
    assert "torcs torcs-data" in game
    assert "xvfb libgl1-mesa-dri" in display


def test_a_display_is_for_root_alone_to_install(machine, tmp_path, monkeypatch, capsys):
    write_game(tmp_path / "usr")
    assert main(["install-torcs", "--video"]) == 1
    assert "type: sudo apt-get install xvfb libgl1-mesa-dri" in capsys.readouterr().err
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert main(["install-torcs", "--video", "--check"]) == 1
    assert log(machine) == []
    (machine / "no-install").touch()
    assert main(["install-torcs", "--video"]) == 1
    assert "could not install xvfb" in capsys.readouterr().err


def test_root_can_choose_to_leave_the_system_alone(machine, root, own, tmp_path):
    assert main(["install-torcs", "--user"]) == 0
    assert (own / "torcs" / "usr").is_dir()
    assert not (tmp_path / "usr").exists()


def test_with_root_the_lists_are_updated_if_the_game_is_unknown(machine, root):
    (machine / "known").unlink()
    assert main(["install-torcs"]) == 0
    assert [line.split()[1] for line in log(machine) if "apt-get" in line] == ["update", "install"]


def test_without_root_the_lists_are_private_if_the_system_has_none(machine, own):
    (machine / "known").unlink()
    assert main(["install-torcs"]) == 0
    (update,) = [line for line in log(machine) if line.endswith("update")]
    assert f"Dir::State::Lists={own}/.torcs-" in update
    assert [path.name for path in own.iterdir()] == ["torcs"]


def test_half_an_old_one_is_replaced(machine, own):
    write_game(own / "torcs" / "usr")
    (own / "torcs/usr/lib/torcs/lib/libtgf.so").unlink()
    (own / "torcs" / "old").touch()
    assert main(["install-torcs"]) == 0
    assert (own / "torcs/usr/lib/torcs/lib/libtgf.so").is_file()
    assert not (own / "torcs" / "old").exists()
    assert [path.name for path in own.iterdir()] == ["torcs"]


@pytest.mark.parametrize(
    ("troubles", "status", "message"),
    [
        (["no-download"], 1, "`apt-get` failed: E: no-download as told; nothing was changed\n"),
        (["disk-full"], 1, "`dpkg-deb` failed: E: disk-full as told; nothing was changed\n"),
        (["interrupt"], 130, ""),
        (["-known", "no-network"], 1, "E: no-network as told"),
        (["-game/lib/torcs/lib/libtgf.so"], 1, "incomplete, missing"),
    ],
)
def test_a_failure_leaves_nothing_and_says_why(machine, own, capsys, troubles, status, message):
    for name in troubles:
        file = machine / name.removeprefix("-")
        file.unlink() if name.startswith("-") else file.touch()
    assert main(["install-torcs"]) == status
    assert message in capsys.readouterr().err
    assert list(own.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_told(machine, tmp_path, capsys):
    (tmp_path / "data").write_text("a file")
    assert main(["install-torcs"]) == 2
    assert "cannot write to the folder" in capsys.readouterr().err


def test_a_failure_leaves_the_old_one(machine, own):
    write_game(own / "torcs" / "usr")
    (own / "torcs/usr/lib/torcs/lib/libtgf.so").unlink()
    (machine / "disk-full").touch()
    assert main(["install-torcs"]) == 1
    assert (own / "torcs/usr/lib/torcs/lib/libtxml.so").is_file()
    assert [path.name for path in own.iterdir()] == ["torcs"]


def test_an_apt_that_fails_is_tried_once_more_with_new_lists(machine, root, capsys):
    (machine / "no-install").touch()
    assert main(["install-torcs"]) == 1
    assert "sb3-torcs install-torcs --user" in capsys.readouterr().err
    verbs = [line.split()[1] for line in log(machine) if "apt-get" in line]
    assert verbs == ["install", "update", "install"]


def test_elsewhere_it_says_what_to_do(machine, capsys):
    (machine / "bin" / "dpkg-deb").unlink()
    assert main(["install-torcs"]) == 1
    err = capsys.readouterr().err
    for word in ("apt-get and dpkg-deb", "dnf install torcs", "Arch", "sourceforge", "HOME"):
        assert word in err
    assert log(machine) == []


def test_a_named_folder_without_a_game_is_not_papered_over(machine, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path / "empty"))
    assert main(["install-torcs"]) == 1
    assert "no other folder is looked at while SB3_TORCS_HOME is set" in capsys.readouterr().err
    assert log(machine) == []
