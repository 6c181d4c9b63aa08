"""Every example and tool runs as it stands, in seconds; the demo keeps its promises."""

import importlib.util
import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from made_agents import copied_agent
from stable_baselines3 import PPO

from sb3_torcs.agents.drivers import find_drivers
from sb3_torcs.agents.models import AGENTS, driver_record, find_model
from sb3_torcs.agents.saved.file import learned_weights, saved_weights
from sb3_torcs.agents.saved.writing import RecordCallback, recipe, write_record
from sb3_torcs.callbacks.lines import DrivenLap, driven_laps
from sb3_torcs.errors import OutputNotWritable
from sb3_torcs.studies.config import read_study
from sb3_torcs.training import zoo

ROOT = Path(__file__).parent.parent
EXAMPLES, TOOLS = ROOT / "examples", ROOT / "tools"


def run(monkeypatch, name, *words):
    monkeypatch.setattr(sys, "argv", [name, *words])
    folder = EXAMPLES if (EXAMPLES / name).exists() else TOOLS
    return runpy.run_path(str(folder / name), run_name="__main__")


def test_the_growth_is_drawn_from_what_was_measured(monkeypatch, capsys, tmp_path):
    found = {"races": {"1": [9e3] * 7}, "opponents": [1e3] * 10, "batches": [2e4] * 8}
    (tmp_path / "growth.json").write_text(json.dumps(found))
    run(monkeypatch, "growth.py", "--from-json", "--output", str(tmp_path / "growth"))
    assert capsys.readouterr().out == f"{tmp_path}/growth.png\n"
    assert (tmp_path / "growth.png").read_bytes()[:4] == b"\x89PNG"


@pytest.fixture
def demo():
    """A fresh copy of the demo's module."""
    spec = importlib.util.spec_from_file_location("demo", EXAMPLES / "demo.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_train_saves_a_model_that_evaluate_drives(monkeypatch, capsys, tmp_path):
    run(monkeypatch, "train.py", "--timesteps", "60", "--folder", str(tmp_path))
    assert f"{tmp_path}/model.zip" in capsys.readouterr().out
    run(monkeypatch, "evaluate.py", str(tmp_path / "model"), "--laps", "1")
    assert capsys.readouterr().out.startswith("episode 1: no whole lap;")


def test_evaluate_drives_an_agent_as_it_was_trained(monkeypatch, capsys):
    """With its own range finders, in its own world."""
    run(monkeypatch, "evaluate.py", "ddpg-fallback", "--laps", "1")
    assert "ended by laps" in capsys.readouterr().out


@pytest.mark.rare
def test_broken_tracks_are_refused_or_drive_what_is_written(monkeypatch, capsys, tmp_path):
    run(monkeypatch, "fuzz_tracks.py", "--tracks", "12", "--workers", "1", "--keep", str(tmp_path))
    assert re.search(r"^Torcs-v0: 12 files: ", capsys.readouterr().out, re.MULTILINE)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.rare
@pytest.mark.usefixtures("game")
def test_foresight_leaves_hits_out(monkeypatch, capsys):
    found = []
    for words in (["--blind"], []):
        run(monkeypatch, "foresight.py", "--races", "1", "--laps", "1", *words)
        (line,) = capsys.readouterr().out.splitlines()
        found.append(int(re.fullmatch(r"race 0: place \d+, (\d+) points .*laps", line)[1]))
    assert found[0] > 100 > found[1]


def test_a_racer_is_trained_alone_and_against_robots(monkeypatch, capsys, tmp_path, game):
    budget = [f"--{stage}=1" for stage in ("alone", "robots")]
    run(monkeypatch, "train_racer.py", *budget, "--races", "2", "--folder", str(tmp_path))
    assert f"{tmp_path}/model.zip" in capsys.readouterr().out
    (racer,) = find_drivers([str(tmp_path / "model.zip")])
    assert racer.name == "model"


@pytest.mark.rare
def test_a_careful_racer_goes_on_without_the_decay(monkeypatch, tmp_path, game):
    careful, racer = (str(tmp_path / name) for name in ("careful", "racer"))
    costs = ["--robots=1", "--races=2", "--sliding=0.5"]
    decay = ["--alone=1", "--weight-decay=0.0003"]
    run(monkeypatch, "train_racer.py", *costs, *decay, "--folder", careful)
    going_on = ["--racer", f"{careful}/model.zip", "--damage=0.6"]
    run(monkeypatch, "train_racer.py", *costs, *going_on, "--folder", racer)
    for folder, expected in ((careful, 0.0003), (racer, 0.0)):
        policy = PPO.load(f"{folder}/model.zip", device="cpu").policy
        assert policy.optimizer.param_groups[0]["weight_decay"] == expected


@pytest.mark.parametrize("driver", [
    "ppo-any-road",
    pytest.param("ppo-aalborg", marks=pytest.mark.rare),
    pytest.param("ppo-post", marks=pytest.mark.rare),
])  # fmt: skip
def test_a_racer_goes_on_from_a_lone_driver(driver, monkeypatch, capsys, tmp_path, game):
    """
    Also from a student, whose file has no value function, more units, and a sensor that comes after
    the rivals.
    """
    budget = ["--driver", driver, "--values=1", "--robots=1", "--races=2"]
    run(monkeypatch, "train_racer.py", *budget, "--folder", str(tmp_path))
    assert f"{tmp_path}/model.zip" in capsys.readouterr().out
    weights = saved_weights(tmp_path / "model.zip")
    assert all(tensor.isfinite().all() for tensor in weights.values())
    sees = driver_record(driver).env_kwargs.get("sensors", ["base"])
    assert driver_record(tmp_path / "model.zip").env_kwargs["sensors"] == [*sees, "rivals"]


@pytest.mark.parametrize("ancestor", [
    "ppo-racer", pytest.param("ppo-any-road", marks=pytest.mark.rare),
])  # fmt: skip
def test_a_racer_races_against_its_ancestor(ancestor, monkeypatch, tmp_path, game):
    """Which drives alone, and has no value function, or races; both are kept but for an update."""
    budget = ["--ancestor", ancestor, "--values=1", "--robots=1", "--races=2"]
    run(monkeypatch, "train_racer.py", *budget, "--track", "g-track-1", "--folder", str(tmp_path))
    record = driver_record(tmp_path / "model.zip")
    assert record.env_kwargs["aids"] == ["unstick", "keep_clear", "catch_slides"]
    bias = "action_net.linear.bias"
    before, after = (learned_weights(find_model(m))[bias] for m in (ancestor, tmp_path / "model"))
    np.testing.assert_allclose(after, before, atol=0.01)


@pytest.mark.parametrize(("driver", "message"), [
    ("ddpg-aalborg", "'ddpg-aalborg' drives with action=\"pedals\"; take a"),
    ("agent.zip", "sees several timesteps at once, or"),  # or others than its record says
    ("other.zip", "ActorCriticPolicy; take a model of PPO with"),
])  # fmt: skip
def test_a_racer_needs_a_driver_of_its_kind(driver, message, monkeypatch, tmp_path, game):
    monkeypatch.chdir(tmp_path)
    copied_agent("ppo-any-road", "agent.zip", sensors=["base"])
    with gym.make("Torcs-v0", action="pedal") as env:
        model = PPO("MlpPolicy", env, n_steps=2, batch_size=2, device="cpu")
        model.learn(2, callback=RecordCallback())
    model.save("other.zip")
    with pytest.raises(SystemExit, match=message):
        run(monkeypatch, "train_racer.py", "--driver", driver, "--folder", str(tmp_path))


def test_specialists_teach_one_student(monkeypatch, capsys, tmp_path, game):
    words = ["ppo-any-road", "--track", "forza", "--timesteps=1", "--folder", str(tmp_path)]
    run(monkeypatch, "specialize.py", *words)
    specialist = str(tmp_path / "forza.zip")
    assert f"sb3-torcs evaluate {specialist}" in capsys.readouterr().out
    both = f"{specialist},ppo-any-road"
    teaching = ["--teach", both, "forza", "--teach", "ppo-any-road", "aalborg", "eroad"]
    budget = ["--rounds=1", "--lessons=1", "--cars=1", "--folder", str(tmp_path / "student")]
    run(monkeypatch, "distill.py", *teaching, "--mirror", "--grip=0.85", *budget)
    student = tmp_path / "student" / "model.zip"
    assert f"saved {student}" in capsys.readouterr().out
    assert driver_record(student).env_kwargs["track"] == ["forza", "aalborg", "eroad"]


@pytest.mark.parametrize("words", [
    ["specialize.py", "agent.zip", "--track", "forza"],
    ["distill.py", "--teach", "agent.zip", "forza"],
    ["distill.py", "--teach", "ppo-any-road", "forza", "--student", "agent.zip"],
])  # fmt: skip
def test_an_agent_that_sees_several_timesteps_is_refused(words, monkeypatch, tmp_path, game):
    monkeypatch.chdir(tmp_path)
    copied_agent("ppo-any-road", "agent.zip", frame_stack=4)
    with pytest.raises(SystemExit, match=r"agent\.zip sees 4 timesteps at once; give another"):
        run(monkeypatch, *words, "--folder", str(tmp_path))


def test_a_specialist_of_a_student_learns_its_value_function_anew(monkeypatch, tmp_path, game):
    """The shipped file of a student has NaN where its value function would be."""
    words = ["ppo-everywhere", "--track", "forza", "--timesteps=1", "--folder", str(tmp_path)]
    run(monkeypatch, "specialize.py", *words)
    weights = PPO.load(tmp_path / "forza.zip", device="cpu").policy.state_dict()
    assert all(value.isfinite().all() for value in weights.values())


@pytest.mark.rare
def test_a_student_that_sees_less_learns_on_together(monkeypatch, capsys, tmp_path, game):
    """Its teachers see the racing line, and so does its value function; it does not."""
    budget = ["--rounds=1", "--lessons=1", "--cars=1", "--folder", str(tmp_path)]
    teaching = ["--teach", "ppo-any-road", "forza", "aalborg", "--actor-sensors", "base"]
    run(monkeypatch, "distill.py", *teaching, *budget)
    student = str(tmp_path / "model.zip")
    words = ["--track", "forza", "aalborg", "--timesteps=1", "--values=1"]
    run(monkeypatch, "specialize.py", student, "--together", *words, "--folder", str(tmp_path))
    told = f"sb3-torcs evaluate {tmp_path / 'together.zip'} --track forza"
    assert told in capsys.readouterr().out
    policy = PPO.load(tmp_path / "together.zip", device="cpu").policy
    assert policy.actor_sensors == ("base",)
    assert policy.mlp_extractor.policy_net[0].in_features == 29
    assert policy.mlp_extractor.value_net[0].in_features > 29


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """What the scripts ask of commands that only write it down."""
    monkeypatch.chdir(tmp_path)
    asked = tmp_path / "asked"
    for name in ("python", "sb3-torcs", "git", "tar"):
        command = tmp_path / name
        command.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
        command.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return asked


def test_everywhere_teaches_by_models_that_are_there_or_were_made_before(asked):
    subprocess.run(["sh", TOOLS / "everywhere.sh"], check=True)
    first, second, *calls = asked.read_text().splitlines()
    assert {first, second} == {
        "archive 70f23c0 sb3_torcs/agents", "-x -C logs/retired --strip-components 2"
    }  # fmt: skip
    retired = ("ppo-dirt", "ppo-dirt-2", "ppo-ole-road-1", "ppo-roads")
    made = {f"logs/retired/{name}/best_model.zip" for name in retired}
    for call in calls:
        options = [option.split() for option in call.split(" --")]
        given = {name: values for name, *values in options}
        needed = {values[0] for name, *values in options if name in ("teach", "student")}
        needed |= {words[1] for words in options if words[0].endswith("specialize.py")}
        assert needed <= made
        (folder,) = given["folder"]
        made |= {f"{folder}/{track}.zip" for track in given.get("track", ["model"])}
    assert sum("specialists" in model for model in made) == 22
    assert "logs/everywhere/model.zip" in made


def test_agents_of_the_29_numbers_go_on_from_a_student(asked):
    """Three of them, two at a time, which then drive all roads and ovals."""
    subprocess.run(["sh", TOOLS / "post_roads.sh"], check=True)
    first, *going_on, learned, unseen, ovals = asked.read_text().splitlines()
    assert "distill.py --teach ppo-any-road aalborg " in first
    assert first.endswith("--folder logs/post-roads/student")
    assert len(going_on) == 3
    for seed, call in enumerate(sorted(going_on, key=lambda call: call.split(" --seed ")[1])):
        assert "specialize.py logs/post-roads/student/model.zip --together" in call
        assert call.endswith(f"--seed {seed} --timesteps 8000000 --folder logs/post-roads/{seed}")
    for call in (learned, unseen, ovals):
        assert "evaluate_tracks.py logs/post-roads/[012]/together.zip" in call


def test_students_for_any_road_learn_from_the_models_of_the_study(asked):
    subprocess.run(["sh", TOOLS / "any_road.sh"], check=True)
    study, *calls = asked.read_text().splitlines()
    folder = study.rpartition(" ")[2]
    trials = read_study(EXAMPLES / "studies" / "open_roads.yml").trials
    teachers = [name for call in calls for name in re.findall(rf"{folder}/[^ ,]*", call)]
    assert teachers == [f"{folder}/default-seed{seed}/best_model.zip" for seed in range(15)]
    assert {trial.seed for trial in trials} == set(range(15))
    learned = " ".join(trials[0].env_kwargs["track"])
    assert sum(learned in call for call in calls) == 5 + 2  # each student, and two evaluations


def test_tracks_are_driven_and_compared_with_robots(tmp_path, game):
    program = [sys.executable, EXAMPLES / "evaluate_tracks.py", "ppo-everywhere", "--jobs=1"]
    words = ["--track", "g-track-1", "michigan", "aalborg", "--without", "aalborg"]
    done = subprocess.run([*program, *words], capture_output=True, text=True, check=True)
    assert re.search(r"^michigan +3 ", done.stdout, re.MULTILINE)
    assert "ppo-everywhere: completes 2 of 2, 2 without damage; median gap" in done.stdout


@pytest.mark.rare
def test_on_a_random_road_the_robots_drive_first(monkeypatch, tmp_path, game):
    run(monkeypatch, "random_roads.py", str(tmp_path), "--number", "1")
    (road,) = tmp_path.iterdir()
    program = [sys.executable, EXAMPLES / "evaluate_tracks.py", "ppo-any-road", "--jobs=1"]
    done = subprocess.run([*program, "--track", road], capture_output=True, text=True, check=True)
    (row,) = re.findall(r"^random-0 +3 +(\S+) +(\S+) +(\S+) +0 ", done.stdout, re.MULTILINE)
    lap, robot, gap = map(float, row)
    assert gap == pytest.approx(100 * (lap / robot - 1), abs=0.06)
    assert lap < robot


@pytest.mark.parametrize(("name", "words", "message"), [
    ("specialize.py", ["ddpg-aalborg", "--track", "forza"], "ddpg-aalborg is no model of PPO"),
    ("distill.py", ["--teach", "ddpg-aalborg", "forza"], "ddpg-aalborg is no model of PPO"),
    ("distill.py", ["--teach", "ppo-any-road"], "ppo-any-road teaches nowhere"),
    ("distill.py", ["--teach", "ppo-league", "corkscrew", "--teach", "ppo-everywhere", "forza"],
     r"ppo-everywhere drives with .*'car1-trb1'.*'car1-ow1'"),
    ("distill.py", ["--teach", "ppo-everywhere", "forza", "--teach", "ppo-racer", "aalborg"],
     "ppo-racer drives with "),
])  # fmt: skip
def test_who_cannot_teach_is_told_so(name, words, message, monkeypatch, tmp_path, game):
    with pytest.raises(SystemExit, match=message):
        run(monkeypatch, name, *words, "--folder", str(tmp_path))


@pytest.mark.parametrize(("name", "words"), [
    ("specialize.py", ["--track", "forza"]), ("distill.py", ["forza"]),
])  # fmt: skip
def test_who_drives_with_two_pedals_cannot_teach(name, words, monkeypatch, tmp_path, game):
    model = str(tmp_path / "model.zip")
    newborn = PPO("MlpPolicy", gym.make("TorcsLite-v0"), device="cpu")
    write_record(newborn, recipe("ppo", "TorcsLite-v0", {}))
    newborn.save(model)
    teach = ["--teach"] if name == "distill.py" else []
    with pytest.raises(SystemExit, match=r"does not drive with action=.pedal.; give one, e\.g"):
        run(monkeypatch, name, *teach, model, *words, "--folder", str(tmp_path))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("evaluate_tracks.py", ["ppo-any-raod", "--track", "g-track-1"]),
        ("distill.py", ["--teach", "ppo-any-raod", "aalborg"]),
        ("specialize.py", ["ppo-any-raod", "--track", "aalborg"]),
        ("train_racer.py", ["--driver", "ppo-any-raod"]),
        ("compare_scr.py", ["ppo-any-raod"]),
        ("compare_laps.py", ["ppo-any-raod"]),
    ],
)
def test_a_wrong_name_ends_a_script_in_a_line(script, words, monkeypatch, tmp_path, game):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"^error: there is no \w+ 'ppo-any-raod'.*; did you"):
        run(monkeypatch, script, *words)


def test_own_reward_learns_from_it(monkeypatch, capsys):
    run(monkeypatch, "own_reward.py", "--timesteps", "120")
    assert "the best return by this reward was" in capsys.readouterr().out


def test_the_first_lap_is_waited_for_as_long_as_asked(monkeypatch, capsys):
    words = ["--env", "TorcsLite-v0", "--seeds", "1", "--every", "1", "--limit", "0"]
    run(monkeypatch, "first_lap.py", *words)
    assert capsys.readouterr().out == "seed 0: first lap None; 3 laps None\n"


def test_the_scripted_driver_laps_a_track(monkeypatch, capsys):
    run(monkeypatch, "scripted_driver.py", "--track", "g-track-1")
    out = capsys.readouterr().out
    assert out.startswith("g-track-1: ")
    assert out.endswith("ended by laps\n")


@pytest.mark.rare
def test_the_soak_of_robots_finds_nothing():
    words = "--robots inferno,bt --tracks alpine-1,dirt-1 --starts 3 --seconds 2 --together"
    program = [sys.executable, TOOLS / "soak_robots.py", *words.split(), "--processes", "1"]
    soaked = subprocess.run(program, capture_output=True, text=True, check=False)
    assert soaked.returncode == 0, soaked.stdout
    assert soaked.stdout.startswith("6 starts: 0 crashed")


@pytest.mark.parametrize(("words", "wanted", "done", "answer", "plan"), [
    ("", None, 0, None, "fresh"),
    ("--continue", None, 0, None, "fresh"),
    ("--fresh", 100, 50, None, "fresh"),
    ("--continue", 100, 50, None, "continue"),
    ("", 100, 50, None, "continue"),
    ("", 100, 100, None, "show"),
    ("--timesteps 200", 100, 100, None, "continue"),
    ("", 100, 50, "", "continue"),
    ("", 100, 50, "f", "fresh"),
    ("", 100, 100, "", "show"),
    ("", 100, 100, "fresh", "fresh"),
])  # fmt: skip
def test_the_demo_asks_on_a_terminal_and_else_goes_on_or_shows(
    demo, monkeypatch, words, wanted, done, answer, plan
):
    monkeypatch.setattr(sys.stdin, "isatty", lambda: answer is not None, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: answer)
    assert demo.choose(demo.parse(words.split()), wanted, done) == plan


def test_a_fresh_start_removes_nothing_that_is_not_the_demos(demo, tmp_path):
    for name in ("model.zip", "notes.txt"):
        (tmp_path / name).write_text("theirs")
    with pytest.raises(OutputNotWritable, match="--folder"):
        demo.clear(tmp_path)
    (tmp_path / "model.zip").rename(tmp_path / "other.zip")
    (tmp_path / demo.STATE).write_text("{}")
    demo.clear(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "other.zip"]


def test_half_a_state_is_no_obstacle(demo, tmp_path):
    (tmp_path / demo.STATE).write_text('{"timest')
    assert demo.read_state(tmp_path) == (demo.TIMESTEPS, 0)


def test_one_failed_part_of_the_show_does_not_lose_the_others(demo, monkeypatch, capsys, tmp_path):
    def broken(folder):
        raise RuntimeError("no encoder")

    monkeypatch.setattr(demo, "runs", lambda folder: [folder])
    monkeypatch.setattr(demo, "keep_models", lambda folder: "models kept")
    monkeypatch.setattr(demo, "curve", lambda folder: "curve drawn")
    monkeypatch.setattr(demo, "draw", broken)
    monkeypatch.setattr(demo, "video", lambda folder: "recorded")
    assert demo.show(tmp_path, interrupted=False)
    out = capsys.readouterr().out
    failed = "the picture: failed: RuntimeError: no encoder"
    assert out.splitlines() == ["models kept", "curve drawn", failed, "recorded"]


def test_ctrl_c_shows_and_says_how_to_go_on(demo, monkeypatch, capsys, tmp_path):
    def stopped(options):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "train_run", stopped)
    assert demo.main(["--timesteps", "300", "--folder", str(tmp_path)]) == 130
    assert "Nothing was learned yet" in capsys.readouterr().out
    assert json.loads((tmp_path / demo.STATE).read_text())["timesteps"] == 300


@pytest.mark.parametrize("env", ["Torcs-v0", "TorcsLite-v0"])
def test_the_demo_learns_where_this_machine_can(demo, monkeypatch, tmp_path, env):
    monkeypatch.setattr(demo, "choose_world", lambda: env)
    assert demo.course_of(tmp_path) == demo.Course("ppo", env, "Torcs-v0")
    first, *_ = demo.first_words(tmp_path, demo.course_of(tmp_path), 1, False)
    assert ("in TORCS itself" in first) == (env == "Torcs-v0")
    place = zoo.Place(zoo.config_file(demo.ALGO), demo.ENTRY)
    zoo.check_entry(zoo.read_entry(*place), demo.ALGO, env, place)


def test_the_demo_says_when_the_first_lap_was(demo, monkeypatch, tmp_path):
    monkeypatch.setattr(demo, "draw_learning", lambda folder, path: None)
    monkeypatch.setattr(demo, "driven_laps", lambda folder: [
        DrivenLap(12.0, 2048, 296.0, None, "001.png"), DrivenLap(72.4, 4096, 2692.0, 98.47, ""),
    ])  # fmt: skip
    assert demo.curve(tmp_path).endswith("how it learned, the first whole lap after 1 min 12 s")


@pytest.mark.parametrize(("algo", "entry"), [("ppo", "Torcs-v0"), ("ddpg", None)])
def test_the_demo_goes_on_with_what_was_begun(demo, tmp_path, algo, entry):
    """Also with that of an earlier version, which had another algorithm."""
    run_folder = tmp_path / "runs" / algo / "TorcsLite-v0_1"
    run_folder.mkdir(parents=True)
    (run_folder / "best_model.zip").write_text("")
    assert demo.course_of(tmp_path) == demo.Course(algo, "TorcsLite-v0", entry)


@pytest.mark.slow
@pytest.mark.usefixtures("game")
def test_the_demo_learns_shows_goes_on_and_shows_again(demo, capsys, tmp_path):
    folder = tmp_path / "demo"
    words = ["--timesteps", "2048", "--folder", str(folder)]
    assert demo.main(words) == 0
    made = "model.zip", "last_model.zip", "lap.mp4", "line.png", "learning.png", "tensorboard"
    for name in made:
        assert (folder / name).exists(), name
    out, err = capsys.readouterr()
    assert "Learned from 2,048 of 2,048 timesteps." in out
    assert f"evaluate {folder / 'model.zip'} --env Torcs-v0" in out
    assert f"the line it drives, {folder / 'lines' / '001.png'}" in err

    assert demo.main(["--continue", "--timesteps", "4096", "--folder", str(folder)]) == 0
    assert "Learned from 4,096 of 4,096 timesteps." in capsys.readouterr().out
    assert [lap.timesteps for lap in driven_laps(folder / "lines")] == [2048, 4096]

    assert demo.main(["--folder", str(folder)]) == 0  # shows again, learns nothing
    out = capsys.readouterr().out
    assert "finished training" in out
    assert shlex.quote(f"--fresh --folder {folder}") in out
    assert len(demo.runs(folder)) == 2


def test_evaluations_are_drawn(monkeypatch, capsys, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        file, results = tmp_path / name / "evaluations.npz", np.array([[1.0], [2.0]])
        np.savez(file, timesteps=np.array([100, 200]), results=results)
    picture = tmp_path / "curves.png"
    runs = [str(tmp_path / "one"), str(tmp_path / "two")]
    run(monkeypatch, "plot_evaluations.py", *runs, "--out", str(picture))
    assert picture.stat().st_size > 1000
    assert str(picture) in capsys.readouterr().out


@pytest.mark.usefixtures("game")
def test_laps_are_compared(monkeypatch, capsys, tmp_path):
    picture = tmp_path / "laps.png"
    agent = str(AGENTS / "ddpg-aalborg")
    run(monkeypatch, "compare_laps.py", agent, "inferno", "--out", str(picture))
    ours, line, robot, _, drawn = capsys.readouterr().out.splitlines()
    told = r"in \d+% of it; \d+% of that at most 120 m before a bend, \d+% in one"
    assert re.fullmatch(rf"ddpg-aalborg: [\d.]+ s, on the brake {told}", ours)
    assert re.fullmatch(rf"inferno: 76\.320 s, on the brake {told}", robot)
    told = r"  \d\.\d\d m from the middle of the road, [1-9]\.\d\d m from inferno's line"
    assert re.fullmatch(told, line)
    assert drawn == str(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
