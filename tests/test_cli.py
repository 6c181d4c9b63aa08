import argparse
import dataclasses
import errno
import importlib
import itertools
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import types

import gymnasium as gym
import pytest
import yaml
from fake_game import write_game
from made_agents import copied_agent
from processes import Program
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback

from sb3_torcs import __version__
from sb3_torcs.agents import ScriptedDriver, models
from sb3_torcs.agents.drivers import NamedDriver
from sb3_torcs.agents.saved import record as model_record
from sb3_torcs.bench.stages import KEYS
from sb3_torcs.cli import VERBS, _parser, common, doctor, evaluate, main, requirements
from sb3_torcs.errors import BackendUnavailable, InvalidOption, OutputNotWritable, ZooConfigError
from sb3_torcs.evaluation import pictures
from sb3_torcs.evaluation import protocol as evaluation
from sb3_torcs.torcs import building
from sb3_torcs.torcs import process as game_process
from sb3_torcs.training import run as training_run
from sb3_torcs.training.run import TrainOptions

NAMES = [verb.__name__.rpartition(".")[2].replace("_", "-") for verb in VERBS]
PNG = b"\x89PNG"

ENTRY = {
    "n_timesteps": "6e1",  # YAML takes it for a word
    "policy": "MlpPolicy",
    "learning_starts": 20,
    "buffer_size": 100,
    "batch_size": 4,
    "policy_kwargs": {"net_arch": [4]},
    "env_kwargs": {"track": "aalborg", "reward": "progress", "start": "random"},
}


def run(capsys, *words):
    """Run the command: exit status, standard output, standard error."""
    capsys.readouterr()
    status = main(list(words))
    return status, *capsys.readouterr()


def write_config(tmp_path, **changes):
    path = tmp_path / "own.yml"
    path.write_text(yaml.safe_dump({"TorcsLite-v0": {**ENTRY, **changes}, "other": ENTRY}))
    return str(path)


def options(tmp_path, **changes):
    conf_file = write_config(tmp_path, **changes.pop("entry_changes", {}))
    changes = {"env": "TorcsLite-v0", **changes}
    return TrainOptions(conf_file=conf_file, folder=tmp_path / "logs", **changes)


class InterruptingCallback(BaseCallback):
    """Presses Ctrl-C, and once more while the training ends."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        if self.num_timesteps == self.at:
            try:
                signal.raise_signal(signal.SIGINT)
            finally:
                signal.raise_signal(signal.SIGINT)
        return True


# The frame of it.


@pytest.mark.parametrize("name", NAMES)
def test_each_verb_has_help(capsys, name):
    with pytest.raises(SystemExit) as caught:
        main([name, "--help"])
    assert caught.value.code == 0
    assert f"sb3-torcs {name}" in capsys.readouterr().out


def loaded_by(*words):
    """Run the command in a new process, and say what it has loaded at its end."""
    code = (
        "import sys\nfrom sb3_torcs.cli import main\n"
        "try: main(sys.argv[1:])\nexcept SystemExit: pass\n"
        "print(*sys.modules)"
    )
    call = [sys.executable, "-c", code, *words]
    done = subprocess.run(call, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_help_loads_nothing_heavy():
    """It starts in a blink; torch alone takes seconds."""
    heavy = {"torch", "numba", "stable_baselines3", "matplotlib", "pygame"}
    assert loaded_by("--help") & heavy == set()


@pytest.mark.parametrize("closed", [">&-", "2>&- <&-"])
def test_a_closed_stream_ends_nothing(closed, tmp_path):
    done = subprocess.run(
        f"{sys.executable} -m sb3_torcs.cli tracks --json aalborg --plot line.png {closed}",
        shell=True, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "line.png").read_bytes()[:4] == PNG
    assert bool(done.stdout) == (">&-" not in closed.replace("2>&-", ""))


def test_listing_tracks_does_not_load_torch():
    assert "torch" not in loaded_by("tracks")


def test_driving_does_not_load_the_compiler_of_torch():
    """Its optimizers do, and it takes as long as torch itself."""
    loaded = loaded_by("evaluate", "ddpg-fallback", "--env-kwargs", "max_episode_steps=1")
    assert "torch" in loaded
    assert "torch._dynamo" not in loaded


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["xyz"], "sb3-torcs: error: there is no verb 'xyz'; `sb3-torcs --help` lists them"),
        (["trian"], "there is no verb 'trian'; did you mean 'train'?"),
        (["--verison"], "unrecognized arguments: --verison; did you mean '--version'?\n"),
        (["train", "--trak", "x"], "unrecognized arguments: --trak x; did you mean '--track'?\n"),
        (
            ["tracks", "--jsn=1"],
            "sb3-torcs tracks: error: unrecognized arguments: --jsn=1; did you",
        ),
        (["evaluate", "a", "b"], "sb3-torcs evaluate: error: unrecognized arguments: b\n"),
    ],
)
def test_an_unknown_word_is_a_usage_error_with_its_near_miss(capsys, words, said):
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    assert said in capsys.readouterr().err


def test_the_bare_command_says_what_there_is(capsys):
    status, out, err = run(capsys)
    assert (status, err) == (0, "")
    assert out.startswith("usage: sb3-torcs")
    assert all(name in out for name in NAMES)


def test_the_command_knows_its_version(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert (caught.value.code, capsys.readouterr().out) == (0, f"sb3-torcs {__version__}\n")


def said_with(encoding, text):
    """What a terminal of this encoding gets."""
    code = (
        "import sys\nfrom sb3_torcs.cli.plain import any_terminal\n"
        f"with any_terminal(): print({text!r})"
    )
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    call = [sys.executable, "-c", code]
    return subprocess.run(call, capture_output=True, check=True, env=environment).stdout


@pytest.mark.parametrize(
    ("encoding", "text", "expected"),
    [
        ("utf-8", "90° → é a\udcffb", "90° → é ".encode() + b"a\xffb"),
        ("ascii", "90° m² → é … 赤 a\udcffb", b"90 deg m2 -> e ... \\u8d64 a\xffb"),
    ],
)
def test_any_terminal_takes_any_text(encoding, text, expected):
    """What its encoding lacks in plain letters, and a path as the bytes that it is."""
    assert said_with(encoding, text) == expected + b"\n"


def test_a_help_text_fits_any_terminal():
    """That of watch names a list with an ellipsis."""
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    call = [sys.executable, "-m", "sb3_torcs.cli", "watch", "--help"]
    done = subprocess.run(call, capture_output=True, check=True, env=environment)
    assert b"NAME:I,..." in done.stdout


NOT_UTF8 = os.fsdecode(b"caf\xe9")


def test_a_path_need_not_be_utf8(capfd, tmp_path):
    folder = tmp_path / NOT_UTF8
    folder.mkdir()
    status, _, err = run(capfd, "evaluate", str(folder / "none.zip"))
    assert status == 2
    assert err.startswith("sb3-torcs: there is no model")
    assert run(capfd, "tracks", "aalborg", "--plot", str(folder / "a.png"))[0] == 0
    assert (folder / "a.png").read_bytes()[:4] == PNG


def test_the_game_loads_a_track_whose_path_is_not_utf8(capfd, game, tmp_path):
    track = tmp_path / f"{NOT_UTF8}.xml"
    track.write_bytes(game.tracks()["road/g-track-1"].read_bytes())
    words = ["evaluate", "scripted", "--env", "Torcs-v0", "--track", str(track), "--laps", "1"]
    status, out, _ = run(capfd, *words, "--json")
    assert status == 0
    assert json.loads(out)["episodes"][0]["laps"] == 1


def test_a_training_in_a_folder_that_is_not_utf8(capfd, tmp_path):
    """TensorBoard takes none, and says so in a traceback."""
    folder = str(tmp_path / NOT_UTF8)
    words = ["train", "--env", "TorcsLite-v0", "--conf-file", write_config(tmp_path)]
    words += ["--folder", folder, "--no-progress"]
    status, _, err = run(capfd, *words)
    assert status == 2
    assert "whose name is not UTF-8; give another folder: --tensorboard DIR" in err
    assert run(capfd, *words, "--tensorboard", str(tmp_path / "t"))[0] == 0
    assert models.find_model(f"{folder}/ddpg/TorcsLite-v0_1").name == "best_model.zip"


def test_a_mistake_is_told_in_one_line_without_a_traceback(capsys):
    status, out, err = run(capsys, "tracks", "aalborgg")
    assert (status, out) == (2, "")
    assert err.startswith("sb3-torcs: no track 'aalborgg'; did you mean 'aalborg'?")
    assert err.count("\n") == 1


def test_an_interrupt_is_told_by_the_exit_status(capsys, monkeypatch):
    def interrupted(args):
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "run", interrupted)
    assert run(capsys, "doctor") == (130, "", "sb3-torcs: interrupted\n")


def test_a_name_that_is_too_long_is_told(capsys):
    status, _, err = run(capsys, "evaluate", "x" * 300)
    assert status == 2
    assert err.endswith("; type a shorter name\n")


def test_what_follows_two_dashes_is_no_option(capsys):
    assert main(["tracks", "--", "-dash.xml"]) == 2
    assert "-dash.xml'" in capsys.readouterr().err
    assert main(["tracks", "--", "aalborg"]) == 0
    assert "aalborg" in capsys.readouterr().out
    with pytest.raises(SystemExit) as caught:
        main(["doctor", "--", "--verbose"])
    assert caught.value.code == 2
    assert "unrecognized arguments: --verbose" in capsys.readouterr().err


def test_json_has_no_infinities(capsys):
    common.print_json({"a": float("inf"), "b": [float("nan"), 1.5], "c": "x"})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.5], "c": "x"}


def test_a_table_puts_numbers_to_the_right():
    assert common.table(("name", "m"), [("a", "10.0"), ("bcdef", "9.5")]) == (
        "name      m\n-----  ----\na      10.0\nbcdef   9.5"
    )


# tracks


def test_tracks_as_json_is_a_list_of_what_is_in_the_table(capsys):
    status, out, _ = run(capsys, "tracks", "--json")
    tracks = json.loads(out)
    keys = {"name", "category", "length_m", "width_m", "tightest_radius_m", "source"}
    assert status == 0
    assert [set(track) for track in tracks] == [keys] * len(tracks)
    listed = run(capsys, "tracks")[1]
    assert [line.split()[0] for line in listed.splitlines()[2:]] == [t["name"] for t in tracks]


def test_tracks_lists_those_of_the_game_too(capsys, game):
    """Each once: where a bundled one has the same name, that one."""
    listed = json.loads(run(capsys, "tracks", "--json")[1])
    names = [f"{track['category']}/{track['name']}" for track in listed]
    assert sorted(names) == sorted(game.tracks())
    assert {track["source"] for track in listed} == {"bundled", "torcs"}
    sources = {track["name"]: track["source"] for track in listed}
    assert (sources["aalborg"], sources["michigan"]) == ("bundled", "torcs")


def test_tracks_lists_only_those_that_are_named(capsys):
    _, out, _ = run(capsys, "tracks", "alpine-1", "road/aalborg", "--json")
    assert [track["name"] for track in json.loads(out)] == ["alpine-1", "aalborg"]


def test_a_track_is_drawn(capsys, tmp_path):
    picture = tmp_path / "new" / "aalborg.png"
    assert run(capsys, "tracks", "aalborg", "--plot", str(picture))[0] == 0
    assert picture.read_bytes()[:4] == PNG


def test_a_racing_line_is_drawn_into_the_track(capsys, tmp_path):
    plain, lined = tmp_path / "plain.png", tmp_path / "lined.png"
    assert run(capsys, "tracks", "g-track-1", "--plot", str(plain))[0] == 0
    assert run(capsys, "tracks", "g-track-1", "--plot", str(lined), "--racing-line")[0] == 0
    assert lined.read_bytes() != plain.read_bytes()
    status, _, err = run(capsys, "tracks", "g-track-1", "--racing-line")
    assert status == 2
    assert "--racing-line is drawn; say where: --plot FILE.png" in err


@pytest.mark.parametrize("names", [(), ("aalborg", "alpine-1")])
def test_one_track_at_a_time_is_drawn(capsys, names):
    status, _, err = run(capsys, "tracks", *names, "--plot", "x.png")
    assert status == 2
    assert f"--plot draws one track, but {len(names)} are named" in err


def test_a_picture_of_another_kind_is_refused(capsys):
    assert "should end in .png" in run(capsys, "tracks", "aalborg", "--plot", "x.jpg")[2]


# evaluate


LITE = ["--env", "TorcsLite-v0"]


def test_an_evaluation_says_what_happened(capsys):
    words = ["evaluate", "scripted", *LITE, "--track", "g-track-1", "--laps", "1", "--json"]
    status, out, _ = run(capsys, *words)
    result = json.loads(out)
    assert status == 0
    assert list(result) == ["env", "track", "car", "episodes"]
    assert (result["env"], result["track"]) == ("TorcsLite-v0", "g-track-1")
    (episode,) = result["episodes"]
    keys = {"laps", "lap_times", "distance", "end", "damage", "return"}
    assert set(episode) == keys
    assert (episode["laps"], episode["end"], len(episode["lap_times"])) == (1, "laps", 1)
    assert run(capsys, *words) == (0, out, "")


def test_an_evaluation_takes_any_argument_of_the_environment(capsys):
    """Conditions such as a delay are not those of the training unless they are given."""
    words = ["evaluate", "scripted", *LITE, "--track", "g-track-1", "--laps", "1", "--json"]
    times = []
    for more in ([], ["--env-kwargs", "conditions={delay: [3, 4]}", "sensors=[base, preview]"]):
        status, out, _ = run(capsys, *words, *more)
        assert status == 0
        times.append(json.loads(out)["episodes"][0]["lap_times"])
    assert times[0] != times[1]
    status, _, err = run(capsys, *words, "--env-kwargs", "conditons={delay: 3}")
    assert status == 2
    assert (
        "--env-kwargs: unknown env_kwargs: argument 'conditons'; did you mean 'conditions'?" in err
    )


@pytest.mark.parametrize(("setting", "advice"), [
    ("max_episode_steps=10", "the time limit follows from the laps; type --laps L instead"),
    ("laps=2", "type --laps L instead"),
    ("render_mode=5", "type --video FILE.mp4 for a video"),
])  # fmt: skip
def test_an_argument_that_is_chosen_in_another_way(capsys, setting, advice):
    words = ["evaluate", "scripted", *LITE, "--laps", "1", "--env-kwargs", setting]
    status, out, err = run(capsys, *words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert f"--env-kwargs has {setting}" in err
    assert advice in err


def test_without_a_whole_lap_there_are_figures_and_no_report(capsys, tmp_path, plain):
    """The exit status is 0 however the driver drove."""
    page = tmp_path / "rep.html"
    trusted = [str(plain), "--trust", "--algo", "ddpg"]
    words = ["evaluate", *trusted, *LITE, "--laps", "1", "--report", str(page)]
    status, out, err = run(capsys, *words, "--json")
    assert (status, json.loads(out)["episodes"][0]["laps"]) == (0, 0)
    assert err.endswith("sb3-torcs: no report: no whole lap of aalborg was driven\n")
    assert not page.exists()
    assert "report:" not in run(capsys, *words)[1]


def test_a_video_that_fails_takes_nothing_else_with_it(capsys, tmp_path, monkeypatch):
    def fail(*_):
        raise OutputNotWritable("ffmpeg stopped writing")

    monkeypatch.setattr(pictures, "save_video", fail)
    files = {kind: str(tmp_path / f"one{kind}") for kind in (".mp4", ".png", ".parquet", ".html")}
    options = zip(("--video", "--line", "--telemetry", "--report"), files.values(), strict=True)
    words = ["evaluate", "scripted", *LITE, "--laps", "1", *itertools.chain(*options)]
    status, _, err = run(capsys, *words)
    assert status != 0
    assert "ffmpeg" in err
    made = sorted(path.suffix for path in tmp_path.iterdir())
    assert made == [".html", ".parquet", ".png"]


def test_no_report_lays_laps_of_several_roads_on_one(capsys, tmp_path, monkeypatch):
    """Whether the random track is typed, or of the model's own training."""
    record = models.TrainingRecord(env_id="TorcsLite-v0", env_kwargs={"track": "random"})
    driver = NamedDriver("scripted", "scripted", "scripted", record=record)
    monkeypatch.setattr(evaluate, "named_driver", lambda source: driver)
    words = ["evaluate", "scripted", "--report", str(tmp_path / "one.html")]
    for more in ([], ["--track", "random"]):
        status, _, err = run(capsys, *words, *more)
        assert status == 2
        assert "--report compares laps of one track; give --track a name" in err


@pytest.mark.parametrize("words", ["delay", "=3"])
def test_an_argument_without_a_value_is_refused(words):
    with pytest.raises(argparse.ArgumentTypeError, match=r"expected NAME=VALUE, e\.g\. track"):
        common.setting(words)


def test_a_value_that_is_not_yaml_is_refused():
    said = r"'delay=\[3': '\[3' is no value of YAML; e\.g\. aids=\[unstick\]"
    with pytest.raises(argparse.ArgumentTypeError, match=said):
        common.setting("delay=[3")


def test_an_evaluation_as_a_table_has_a_row_per_episode(capsys):
    words = ["evaluate", "scripted", *LITE, "--track", "g-track-1", "--laps", "1"]
    words += ["--episodes", "2"]
    _, out, _ = run(capsys, *words)
    lines = out.splitlines()
    assert lines[0] == "TorcsLite-v0, g-track-1, car1-trb1"
    assert [line.split()[:2] for line in lines[3:]] == [["1", "1"], ["2", "1"]]


@pytest.fixture
def no_game(monkeypatch, tmp_path):
    monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A model that plain SB3 saved: it knows nothing of its environment."""
    file = tmp_path_factory.mktemp("plain") / "driver.zip"
    DDPG("MlpPolicy", "sb3_torcs:TorcsLite-v0", buffer_size=1, device="cpu", seed=0).save(file)
    return file


def driven(capsys, *words):
    """Evaluate: the world that was driven, and what is said about the choice."""
    status, out, err = run(capsys, "evaluate", *map(str, words), "--laps", "1", "--json")
    assert status == 0
    return json.loads(out)["env"], err


@pytest.mark.usefixtures("game")
def test_a_robot_drives_as_any_driver(capsys, tmp_path):
    line = tmp_path / "line.png"
    words = ["inferno", "--track", "g-track-1", "--laps", "1", "--line", str(line), "--json"]
    status, out, _ = run(capsys, "evaluate", *words)
    value = json.loads(out)
    (episode,) = value["episodes"]
    assert (status, value["track"], value["car"]) == (0, "g-track-1", "car1-trb1")
    assert (episode["laps"], episode["end"], episode["return"]) == (1, "laps", None)
    assert line.read_bytes()[:4] == PNG
    for more, message in (
        (["--car", "p406"], "car is for an agent"),
        (["--env", "TorcsLite-v0"], "a robot drives in Torcs-v0"),
    ):
        status, _, err = run(capsys, "evaluate", "inferno", *more)
        assert status == 2
        assert message in err


@pytest.mark.usefixtures("game")
def test_a_driver_without_a_record_drives_in_the_game(capsys, plain):
    for name, track in (("scripted", "a-speedway"), (plain, "aalborg")):
        trust = [] if name == "scripted" else ["--trust", "--algo", "ddpg"]
        world, said = driven(capsys, name, "--track", track, *trust)
        assert world == "Torcs-v0"
        assert (f"'{name}' has no record of its training; track, car," in said) == (name == plain)


def test_an_agent_drives_in_the_world_of_its_training(capsys):
    assert driven(capsys, "ddpg-fallback", "--track", "g-track-1") == ("TorcsLite-v0", "")


def test_a_world_that_is_named_comes_first(capsys):
    words = ["ddpg-fallback", "--track", "g-track-1"]
    assert driven(capsys, *words, "--env", "Torcs-v0") == ("Torcs-v0", "")


@pytest.mark.usefixtures("game")
def test_the_drivers_are_listed(capsys):
    status, out, _ = run(capsys, "drivers", "--json")
    rows = {row["name"]: row for row in json.loads(out)}
    assert status == 0
    assert {row["kind"] for row in rows.values()} == {"agent", "robot", "ghost", "scripted"}
    assert rows["inferno"]["does"].startswith("drives car1-trb1; inferno:")
    assert all(row["does"] for row in rows.values())


def test_options_stand_between_names_too(capsys):
    args = _parser()[0].parse_args(["compare", "bt", "--track", "forza", "inferno"])
    assert (args.drivers, args.track) == (["bt", "inferno"], "forza")


@pytest.mark.parametrize("verb", ["evaluate", "watch", "compare", "race", "compete"])
def test_two_dashes_are_no_value(capsys, verb):
    with pytest.raises(SystemExit):
        main([verb, "scripted", "--track=--"])
    assert "argument --track: '--' is no value" in capsys.readouterr().err


@pytest.mark.usefixtures("no_game")
def test_an_agent_of_the_game_is_not_driven_elsewhere(capsys):
    status, out, err = run(capsys, "evaluate", "ddpg-aalborg", "--json")
    assert (status, out) == (2, "")
    assert "there is no TORCS in" in err


@pytest.mark.usefixtures("no_game")
@pytest.mark.parametrize("words", [
    ("evaluate", "scripted", "--env", "TorcsLite-v0", "--track", "b-speedway"),
    ("train", "--algo", "ppo", "--env", "TorcsLite-v0", "--track", "b-speedway"),
    ("compare", "inferno", "scripted"),
])  # fmt: skip
def test_what_only_the_game_has_is_said_to_be_missing_with_it(capsys, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, _, err = run(capsys, *words)
    assert status == 2
    assert "since TORCS was not found; type: `sb3-torcs install-torcs`" in err


def test_a_deleted_working_folder_is_told(tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    script = f"cd {folder}; rmdir {folder}; {sys.executable} -m sb3_torcs.cli evaluate scripted"
    done = subprocess.run(["sh", "-c", script], capture_output=True, text=True)
    said = "sb3-torcs: the working folder was deleted; go to another one\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", said)


@pytest.mark.parametrize("folder", ["none", "~nobody-of-this-name"])
def test_a_missing_model_is_told(capsys, folder):
    status, _, err = run(capsys, "evaluate", f"{folder}/best_model.zip")
    assert status == 2
    assert f"there is no model '{folder}" in err


@pytest.mark.usefixtures("no_game")
def test_torcs_is_not_replaced_by_something_else(capsys):
    status, out, err = run(capsys, "evaluate", "scripted", "--env", "Torcs-v0", "--json")
    assert (status, out) == (2, "")
    assert err.startswith("sb3-torcs: there is no TORCS in")


def test_an_output_that_cannot_be_written_is_told_before_the_drive(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    words = ["--video", str(tmp_path / "file" / "v.mp4")]
    status, _, err = run(capsys, "evaluate", "none.zip", *words)
    assert status == 2
    assert "cannot write to the folder" in err


def test_what_is_typed_comes_before_the_training():
    words = ["evaluate", "scripted", "--track", "forza", "--env-kwargs", "action_repeat=2"]
    args = _parser()[0].parse_args(words)
    assert common.environment_settings(args) == {"track": "forza", "action_repeat": 2}
    args = _parser()[0].parse_args([*words, "track=aalborg"])
    with pytest.raises(InvalidOption, match="track is given twice; give it one value"):
        common.environment_settings(args)


@pytest.mark.parametrize("verb", ["evaluate", "optimize-lap"])
def test_nobody_draws_the_car_of_an_agent_that_knows_many(capsys, tmp_path, monkeypatch, verb):
    monkeypatch.chdir(tmp_path)
    agent = copied_agent("ppo-any-road", tmp_path / "agent.zip", car=["car1-trb1", "p406"])
    status, _, err = run(capsys, verb, agent, "--track", "aalborg")
    assert status == 2
    assert "say which one it shall drive: --car " in err
    assert [file.name for file in tmp_path.iterdir()] == ["agent.zip"]


def test_the_time_limit_cuts_no_lap_of_a_car_that_does_not_count_as_standing():
    """Three laps of 2587.5 m at 5 km/h take 5589 s, and a timestep takes 0.1 s."""
    kwargs = {"track": "aalborg", "laps": 3}
    assert evaluation.time_limit(kwargs) > 55890
    assert evaluation.time_limit({**kwargs, "action_repeat": 1}) > 5 * 55890
    assert evaluation.time_limit({**kwargs, "track": "random"}) > 55890


@pytest.mark.parametrize("laps", [None, "1", 0, 1.5])
def test_an_evaluation_has_a_number_of_laps(laps):
    with pytest.raises(InvalidOption, match=f"laps is {laps!r}; expected a whole number >= 1"):
        evaluation.race_environment("TorcsLite-v0", {}, track="aalborg", laps=laps)


def test_an_evaluation_takes_its_environment_from_a_record_that_may_be_empty():
    with pytest.raises(InvalidOption, match=r"env_id is None.*pass 'Torcs-v0' or 'TorcsLite-v0'"):
        evaluation.race_environment(None, {}, "aalborg")
    with evaluation.race_environment("TorcsLite-v0", None, "aalborg") as env:
        assert env.get_wrapper_attr("laps") == 3


def test_an_evaluation_refuses_arguments_that_no_environment_has():
    """Those that it leaves out on purpose are no mistake."""
    given = {"opponents": ["bt"], "start": "random", "max_episode_steps": 9, "sensr": ["base"]}
    with pytest.raises(InvalidOption, match=r"'sensr', which no.*did you mean 'sensors'"):
        evaluation.race_environment("TorcsLite-v0", given, "aalborg")
    with pytest.raises(InvalidOption, match="env_kwargs has '1', which no environment takes"):
        evaluation.race_environment("TorcsLite-v0", {1: 2}, "aalborg")
    for wrong in ("five", None, 0, math.nan):
        with pytest.raises(InvalidOption, match=f"action_repeat is {wrong!r}; expected a whole"):
            evaluation.race_environment("TorcsLite-v0", {"action_repeat": wrong}, "aalborg")
    del given["sensr"]
    with evaluation.race_environment("TorcsLite-v0", given, "aalborg") as env:
        assert env.spec.max_episode_steps > 9


@pytest.mark.parametrize("driver", ["ddpg-aalborg", None])
def test_an_evaluation_is_of_something_that_drives(driver):
    with gym.make("TorcsLite-v0") as env:
        message = f"driver is {driver!r}, which has no predict; .*load_driver"
        with pytest.raises(InvalidOption, match=message):
            evaluation.evaluate(env, driver)


@pytest.mark.parametrize("seed", [-1, 0.5, None])
def test_the_seed_of_an_evaluation_is_a_whole_number(seed):
    with gym.make("TorcsLite-v0") as env:
        with pytest.raises(InvalidOption, match=f"seed is {seed}; expected a whole number >= 0"):
            evaluation.evaluate(env, ScriptedDriver(), seed=seed)


def test_an_evaluation_is_of_one_environment():
    with pytest.raises(InvalidOption, match="VectorEnv is no single environment"):
        evaluation.evaluate(gym.make_vec("TorcsLite-v0", num_envs=2), ScriptedDriver())


def test_what_was_driven_is_told_before_a_file_fails(capsys, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pictures, "draw_line", full)
    line = str(tmp_path / "line.png")
    status, out, err = run(capsys, "evaluate", "scripted", *LITE, "--laps", "1", "--line", line)
    assert status == 2
    assert "1     1 " in out.splitlines()[-1]
    assert err.splitlines()[-1].startswith("sb3-torcs: No space left on device")


def test_an_output_that_takes_no_more_is_told():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "sb3_torcs.cli", "tracks"]
        process = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    said = "sb3-torcs: No space left on device: the output; make room, or choose another folder\n"
    assert (process.returncode, process.stderr) == (2, said)


# train


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"entry_changes": {"learning_rat": 1}}, "unknown key 'learning_rat'"),
        ({"env": "TorcsLight-v0"}, "no environment 'TorcsLight-v0' is registered; did you mean"),
        ({"track": "aalborgg"}, "no track 'aalborgg'; did you mean 'aalborg'?"),
        ({"entry": "othr"}, "no entry 'othr'; did you mean 'other'?"),
        ({"resume": "none.zip"}, "there is no model 'none.zip'"),
        ({"algo": "dpg"}, "no algorithm 'dpg'; did you mean 'ddpg'?"),
        ({"hyperparams": {"batchsize": 8}}, "unknown key 'batchsize'"),
        ({"hyperparams": {"learning_rate": "1e-3"}}, "expected a number"),
        ({"env_kwargs": {"trak": "oval"}}, "did you mean 'track'?"),
    ],
)
def test_a_mistake_is_told_before_anything_starts(tmp_path, changes, message):
    with pytest.raises(Exception) as caught:
        training_run.train(options(tmp_path, **changes))
    assert message in str(caught.value)
    assert not (tmp_path / "logs").exists()


def test_an_algorithm_that_cannot_learn_here_is_told_and_leaves_no_run(tmp_path):
    said = "dqn cannot learn in TorcsLite-v0 by this entry: The algorithm only supports .*Discrete"
    with pytest.raises(ZooConfigError, match=said):
        training_run.train(options(tmp_path, algo="dqn"))
    assert not list((tmp_path / "logs" / "dqn").iterdir())


def test_a_training_goes_on_in_the_environment_of_its_model(monkeypatch):
    """Where nothing else is said."""
    asked = []
    monkeypatch.setattr(training_run, "train_run", lambda options: asked.append(options) or 1 / 0)
    for words in (
        ["--resume", "ddpg-aalborg"],
        ["--resume", "ddpg-aalborg", "--env", "TorcsLite-v0", "--algo", "td3"],
        [],
    ):
        with pytest.raises(ZeroDivisionError):
            main(["train", *words])
    assert [(options.env, options.algo) for options in asked] == [
        ("Torcs-v0", "ddpg"), ("TorcsLite-v0", "td3"), ("Torcs-v0", "ddpg")
    ]  # fmt: skip


@pytest.mark.parametrize("option", ["--folder", "--tensorboard"])
def test_a_folder_that_cannot_be_written_is_told_before_the_training(capsys, tmp_path, option):
    (tmp_path / "file").write_text("")
    words = ["--conf-file", write_config(tmp_path), "--folder", str(tmp_path / "logs")]
    words += ["--env", "TorcsLite-v0"]
    status, _, err = run(capsys, "train", *words, option, str(tmp_path / "file" / "logs"))
    assert status == 2
    assert err.startswith("sb3-torcs: cannot write to the folder")


def test_numbers_of_steps_have_to_be_positive(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--timesteps", "0"])
    assert "expected a whole number >= 1" in capsys.readouterr().err


def test_an_evaluation_comes_no_sooner_than_an_update():
    for entry, steps in (({"n_steps": 128, "n_envs": 64}, 8192), ({}, 2048)):
        assert training_run._rollout("ppo", entry) == steps
    assert training_run._rollout("ddpg", {}) == 0


@pytest.mark.parametrize(("name", "value", "least"), [
    ("timesteps", 0, 1), ("timesteps", -7, 1), ("eval_episodes", 0, 1), ("seed", -1, 0),
    ("seed", 0.0, 0),
])  # fmt: skip
def test_numbers_of_a_training_from_python_are_checked_too(tmp_path, name, value, least):
    with pytest.raises(
        InvalidOption, match=f"{name} is {value}; expected a whole number >= {least}"
    ):
        training_run.train(options(tmp_path, **{name: value}))
    assert list(tmp_path.glob("logs*")) == []


def test_pictures_that_cannot_be_written_leave_no_other_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputNotWritable, match="cannot write to the folder"):
        training_run.train(options(tmp_path, pictures=tmp_path / "file"))
    assert not list(tmp_path.glob("logs*"))


@pytest.mark.slow
def test_a_training_leaves_models_and_logs(capsys, tmp_path):
    words = ["--conf-file", write_config(tmp_path), "--folder", str(tmp_path / "logs")]
    words += ["--track", "alpine-1", "--seed", "1", "--env", "TorcsLite-v0"]
    status, out, err = run(capsys, "train", *words)
    folder = tmp_path / "logs" / "ddpg" / "TorcsLite-v0_1"
    assert status == 0
    assert "100% 60/60 timesteps" in err
    assert f"best model by evaluation: {folder / 'best_model.zip'}" in out
    assert models.saved_timesteps(folder / "TorcsLite-v0.zip") == 60
    assert {path.name for path in folder.iterdir()} == {
        "0.monitor.csv", "TorcsLite-v0", "TorcsLite-v0.zip", "best_model.zip", "evaluations.npz",
        "replay_buffer.pkl",
    }  # fmt: skip
    assert list((tmp_path / "logs" / "tensorboard").rglob("events.*")) != []
    for name in ("best_model.zip", "TorcsLite-v0.zip"):
        elsewhere = (folder / name).rename(tmp_path / name)  # a file tells by itself
        record = models.training_record(elsewhere)
        elsewhere.rename(folder / name)
        assert (record.algo, record.env_id) == ("ddpg", "TorcsLite-v0")
        assert record.env_kwargs == {**ENTRY["env_kwargs"], "track": "alpine-1"}
        assert record.hyperparameters["batch_size"] == ENTRY["batch_size"]
    (command,) = [line for line in out.splitlines() if "sb3-torcs evaluate" in line]
    status, out, _ = run(capsys, *shlex.split(command)[1:], "--json")
    assert status == 0
    assert json.loads(out)["track"] == "alpine-1"


@pytest.mark.slow
def test_the_same_seed_trains_the_same_model(tmp_path):
    folders = [training_run.train(options(tmp_path, progress=False)) for _ in range(2)]
    assert [folder.name for folder in folders] == ["TorcsLite-v0_1", "TorcsLite-v0_2"]
    first, second = (DDPG.load(folder / "TorcsLite-v0.zip") for folder in folders)
    for one, other in zip(first.policy.parameters(), second.policy.parameters(), strict=True):
        assert one.equal(other)


@pytest.mark.slow
def test_an_interrupted_training_keeps_what_it_learned_and_says_how_to_go_on(capsys, tmp_path):
    handler = signal.getsignal(signal.SIGINT)  # a job in the background has another
    callback = {f"{__name__}.InterruptingCallback": {"at": 40}}
    conf_file = write_config(tmp_path, callback=[callback])
    words = ["--conf-file", conf_file, "--folder", str(tmp_path / "logs"), "--no-progress"]
    status, out, err = run(capsys, "train", "--env", "TorcsLite-v0", *words)
    last_model = tmp_path / "logs" / "ddpg" / "TorcsLite-v0_1" / "TorcsLite-v0.zip"
    assert status == 130
    assert "saving what was learned" in err
    assert models.saved_timesteps(last_model) == 40
    (command,) = [line for line in out.splitlines() if "--resume" in line]
    status, out, _ = run(capsys, *shlex.split(command)[1:])
    folder = last_model.parent.with_name("TorcsLite-v0_2")
    assert (status, "learned from 20 of 20" in out) == (0, True)
    config = model_record._read_plain(folder / "TorcsLite-v0" / "config.yml")
    assert config["learning_starts"] == 0  # it has its replay buffer, so it needs no new warm-up
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.slow
@pytest.mark.parametrize(
    "by", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.rare)]
)
def test_a_training_that_is_ended_from_outside_keeps_what_it_learned(tmp_path, by):
    """The reader of what it prints may have ended before."""
    conf_file = write_config(tmp_path, n_timesteps=10**6)
    words = ["--conf-file", conf_file, "--folder", str(tmp_path / "logs"), "--eval-freq", "200"]
    folder = tmp_path / "logs" / "ddpg" / "TorcsLite-v0_1"
    reader, writer = os.pipe()
    with Program.of_ours("train", "--env", "TorcsLite-v0", *words, stdout=writer) as program:
        os.close(writer)
        program.wait_for((folder / "best_model.zip").is_file)
        os.close(reader)
        program.end(by)
    assert models.saved_timesteps(folder / "TorcsLite-v0.zip") >= 200
    assert models.find_model(folder, prefer_last=True).name == "TorcsLite-v0.zip"


@pytest.mark.slow
def test_a_training_that_is_killed_leaves_no_temporary_file(tmp_path):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    conf_file = write_config(tmp_path, n_timesteps=10**6)
    words = ["--conf-file", conf_file, "--folder", str(tmp_path / "logs"), "--eval-freq", "200"]
    variables = {**os.environ, "TMPDIR": str(scratch)}
    with Program.of_ours("train", "--env", "TorcsLite-v0", *words, env=variables) as program:
        program.wait_for(lambda: list((tmp_path / "logs").glob("ddpg/*/best_model.zip")))
        program.end(signal.SIGKILL)
    assert list(scratch.iterdir()) == []


def test_a_training_that_a_signal_has_ended_says_which(monkeypatch, capsys, tmp_path):
    by = signal.SIGTERM
    run = training_run.Run(tmp_path, 80, 100, by, tmp_path / "TorcsLite-v0.zip", {})
    monkeypatch.setattr(training_run, "train_run", lambda _: run)
    status = main(["train", "--algo", "ddpg"])
    assert (status, "go on with:" in capsys.readouterr().out) == (128 + by, True)


@pytest.mark.slow
def test_the_shipped_hyperparameters_train(tmp_path):
    run_folder = training_run.train(
        TrainOptions(env="TorcsLite-v0", timesteps=150, folder=tmp_path, progress=False)
    )
    assert (run_folder / "best_model.zip").is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("game")
def test_those_of_the_real_game_train_and_go_on(tmp_path):
    """With returns over several timesteps, whose replay buffer SB3 makes anew in its own way."""
    options = TrainOptions(env="Torcs-v0", timesteps=1100, folder=tmp_path, progress=False)
    first = training_run.train(options)
    second = training_run.train(dataclasses.replace(options, timesteps=100, resume=first))
    model = DDPG.load(second / "best_model.zip", replay_buffer_class=None)
    assert (model.n_steps, model.replay_buffer.n_steps) == (3, 3)


# doctor


PARTS = (
    "python", "TorcsLite-v0", "compiler", "extension", "game", "tracks", "cars", "layout",
    "Torcs-v0", "game program", "game libraries", "window", "video",
)  # fmt: skip


def doctor_says(capsys):
    status, out, _ = run(capsys, "doctor", "--json")
    result = json.loads(out)
    by_name = {check["name"]: check for check in result["checks"]}
    assert len(by_name) == len(result["checks"])
    assert set(PARTS) <= set(by_name)
    assert {tuple(check) for check in result["checks"]} == {("name", "ok", "found", "fix")}
    assert all(bool(check["fix"]) != check["ok"] for check in result["checks"])
    assert (status, result["ok"]) in {(0, True), (1, False)}
    assert result["ok"] == all(check["ok"] for check in result["checks"])
    return result["ok"], by_name


def test_the_doctor_is_content_with_the_game_and_the_engine(capsys, game):
    ok, found = doctor_says(capsys)
    assert ok, [check for check in found.values() if not check["ok"]]
    assert "21 road" in found["tracks"]["found"]
    assert found["game program"]["found"] == str(game.program)


def test_the_doctor_is_not_content_without_the_game(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path))
    ok, found = doctor_says(capsys)
    assert not ok
    assert found["TorcsLite-v0"]["ok"]
    assert found["game"]["found"].startswith(f"there is no TORCS in {tmp_path}")
    assert "`sb3-torcs install-torcs`" in found["game"]["fix"]
    for part in ("tracks", "cars", "layout"):
        assert found[part]["found"] == "there is no game to look at"
        assert found[part]["fix"] == found["game"]["fix"]
    assert not found["Torcs-v0"]["ok"]
    # Nothing that drives in this process needs it.
    assert found["game program"]["ok"]


def test_the_doctor_names_each_missing_part(capsys, monkeypatch, tmp_path):
    write_game(tmp_path)
    (tmp_path / "share/games/torcs/cars/big/big.xml").unlink()
    monkeypatch.setenv("SB3_TORCS_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "sb3_torcs._engine", None)
    monkeypatch.setenv("CXX", "no-such-compiler")
    ok, found = doctor_says(capsys)
    assert not ok
    assert found["compiler"]["found"] == "none of no-such-compiler"
    assert found["extension"] == {
        "name": "extension", "ok": False, "found": "sb3_torcs._engine is not built",
        "fix": building.build_command(),
    }  # fmt: skip
    assert found["game"]["ok"]
    assert "mud-1.xml: there are no track segments" in found["tracks"]["found"]
    assert found["cars"]["found"] == "1, no car1-trb1"
    assert found["layout"]["found"] == "not compared: the extension is missing"
    assert "no torcs-bin" in found["game program"]["found"]


def test_the_doctor_misses_what_only_the_games_own_program_needs(
    capsys, monkeypatch, tmp_path, game
):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(game_process, "__file__", str(tmp_path / "torcs/process.py"))
    ok, found = doctor_says(capsys)
    assert ok, "both environments drive without"
    assert found["video"]["found"].startswith("no Xvfb; type: `sb3-torcs install-torcs --video`")
    assert "`watch --video` and render_mode 'game'" in found["video"]["found"]
    assert "no display; only for `watch`" in found["window"]["found"]
    assert "_scr_server" in found["game libraries"]["found"]
    assert building.build_command() in found["game libraries"]["found"]


def test_the_doctor_compares_the_layout(capsys, monkeypatch, game):
    def check_layout(asked):
        raise BackendUnavailable(f"TORCS at {asked.root} is another version; install 1.3.7")

    for true in ("sb3_torcs.envs.torcs", "sb3_torcs._engine"):  # which go on to drive
        importlib.import_module(true)
    native = types.ModuleType("sb3_torcs.backends.native")
    native.check_layout = check_layout
    engine = types.ModuleType("sb3_torcs._engine")
    engine.__file__ = "engine.so"
    monkeypatch.setitem(sys.modules, "sb3_torcs.backends.native", native)
    monkeypatch.setitem(sys.modules, "sb3_torcs._engine", engine)
    monkeypatch.setenv("CXX", "no-such-compiler")
    ok, found = doctor_says(capsys)
    assert not ok
    assert found["layout"]["found"] == f"TORCS at {game.root} is another version"
    assert found["layout"]["fix"] == "install 1.3.7"
    # What is built already needs no compiler.
    assert found["compiler"]["ok"]


def test_the_doctor_survives_what_is_broken():
    def broken():
        raise RuntimeError("no luck")

    check = doctor._guarded(broken, "this")
    assert (check.name, check.ok, check.found) == ("this", False, "RuntimeError: no luck")


def test_the_doctor_finds_something_in_errors_that_name_no_remedy():
    def check():
        raise BackendUnavailable("the game will not load")

    assert doctor._guarded(check, "game") == doctor.Check(
        "game", False, "the game will not load", None
    )


def test_a_cache_that_cannot_be_written_is_told_with_what_to_type(capsys, monkeypatch):
    def refused(*_):
        raise RuntimeError("cannot cache function 'f': no locator available for file 'x.py'")

    check = doctor._guarded(refused)
    assert check.fix == "export NUMBA_CACHE_DIR=/tmp/numba"
    monkeypatch.setattr(doctor, "run", refused)
    status, _, err = run(capsys, "doctor")
    assert status == 2
    assert err.startswith("sb3-torcs: numba cannot cache function")
    assert err.endswith("type: export NUMBA_CACHE_DIR=/tmp/numba\n")


def test_the_doctor_says_what_to_type(capsys, monkeypatch):
    monkeypatch.setattr(requirements.metadata, "requires", lambda _: ["no-such-package[a,b]>=2"])
    status, out, _ = run(capsys, "doctor")
    assert status == 1
    assert "MISSING  no-such-package" in out
    assert '-> pip install "no-such-package[a,b]>=2"' in out


# bench


@pytest.fixture
def quick_bench(monkeypatch):
    def stages(seconds):
        return {"one": lambda: {"lite_ticks_per_s": 1000.0 * seconds}}

    monkeypatch.setattr("sb3_torcs.bench.stages.stages", stages)


def test_the_bench_prints_every_figure_and_null_for_what_it_cannot_measure(capsys, quick_bench):
    status, out, _ = run(capsys, "bench", "--json", "--seconds", "25")
    figures = json.loads(out)
    assert (status, tuple(figures)) == (0, KEYS)
    assert [name for name, value in figures.items() if value is not None] == ["lite_ticks_per_s"]
    assert figures["lite_ticks_per_s"] == 25000.0


def test_the_bench_as_a_table(capsys, quick_bench):
    lines = run(capsys, "bench")[1].splitlines()
    assert lines[2].split() == ["lite_ticks_per_s", "30000"]
    assert lines[-1].split() == ["training_env_share", "-"]


def test_the_bench_needs_time(capsys):
    assert "expected more than 0" in run(capsys, "bench", "--seconds", "0")[2]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--env", "NoSuch-v0"], "no environment 'NoSuch-v0' is registered; ours: Torcs-v0"),
        (["--env", "TorcsLit-v0"], "did you mean 'TorcsLite-v0'?"),
        (["--env", "CartPole-v1"], "CartPole-v1 is not a racing environment"),
    ],
)
def test_evaluate_refuses_what_is_no_racing_environment(capsys, words, message):
    status, out, err = run(capsys, "evaluate", "scripted", *words)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("verb", [["train"], ["evaluate", "scripted"]])
@pytest.mark.parametrize(
    ("seed", "message"), [("-1", ">= 0"), ("²", ">= 0"), (str(2**32), "below 2**32")]
)
def test_a_seed_that_numpy_does_not_take_is_refused(capsys, verb, seed, message):
    with pytest.raises(SystemExit) as caught:
        main([*verb, "--seed", seed])
    assert caught.value.code == 2
    assert f"'{seed}': expected a whole number {message}" in capsys.readouterr().err


@pytest.mark.parametrize(("wrapper", "says"), [
    ("TransformReward", "an env_wrapper does not go around the car (TransformReward.__init__() "),
    ("TransformReward", "; give its arguments below its dotted path"),
    ("TimeAwareObservation", "shows a training's time limit, and a race has another"),
])  # fmt: skip
def test_a_wrapper_that_cannot_be_used_is_told_with_its_entry(capsys, tmp_path, wrapper, says):
    file = tmp_path / "own.yml"
    path = f"gymnasium.wrappers.{wrapper}"
    file.write_text(f"TorcsLite-v0: {{n_timesteps: 60, policy: MlpPolicy, env_wrapper: {path}}}\n")
    words = ["train", "--algo", "sac", "--env", "TorcsLite-v0", "--conf-file", str(file)]
    words += ["--folder", str(tmp_path / "logs")]
    status, _, err = run(capsys, *words)
    assert (status, err.count("\n")) == (2, 1)
    assert f"{file}, entry 'TorcsLite-v0': " in err
    assert says in err
    assert not (tmp_path / "logs").exists()
