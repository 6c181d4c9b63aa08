"""A training of a study depends on its recipe alone: it can be killed at any evaluation."""

import json

import numpy as np
import pytest
import torch as th
import yaml

from sb3_torcs.cli import main
from sb3_torcs.errors import StudyError
from sb3_torcs.evaluation.protocol import Episode
from sb3_torcs.studies.config import read_study
from sb3_torcs.studies.rows import final_row
from sb3_torcs.training.trial import Training

CLOCKS = ("wall_s", "cpu_s")
TINY = {
    "learning_starts": 30, "buffer_size": 200, "batch_size": 16,
    "policy_kwargs": {"net_arch": [16, 16], "head_bias": [0.0, 1.0, -3.0]},  # it sets off
}  # fmt: skip
CASES = {
    "four cars": {},
    "one car, three-step returns, falling rate": {
        "n_envs": 1, "n_steps": 3, "learning_rate": "lin_2e-4",
    },
    "normalized observations": {"normalize": {"norm_obs": True, "norm_reward": False}},
    "what the default on the real game has": {
        "n_steps": 3,
        "learning_rate": "lin_2e-4",
        "policy_kwargs": {**TINY["policy_kwargs"], "ema_decay": 0.9},
        "callback": {
            "sb3_torcs.callbacks.RandomStartCallback": {"speed": 30.0},
            "sb3_torcs.callbacks.NoiseCallback": {"kind": "ou", "dt": 0.1},
            "sb3_torcs.callbacks.NoiseDecayCallback": {"timesteps": 200, "floor": 0.35},
            "sb3_torcs.callbacks.replay.GradientStepsCallback": {
                "gradient_steps": 5, "timesteps": 120,
            },
            "sb3_torcs.callbacks.replay.MirrorCallback": {},
        },
    },
    "the post's noise and brake": {
        "n_envs": 2,
        "callback": {
            "sb3_torcs.callbacks.NoiseCallback": {"kind": "set_point", "dt": 1.0},
            "sb3_torcs.callbacks.StochasticBrakeCallback": {"probability": 0.5},
        },
    },
}  # fmt: skip
PPO = {
    "algo": "ppo", "n_steps": 16, "n_envs": 2, "batch_size": 32, "learning_rate": "lin_2e-4",
    "policy_kwargs": {"net_arch": [16]},
}  # fmt: skip


def trial(tmp_path, changes, **more):
    said = {
        "name": "test", "env": "TorcsLite-v0", "seeds": [3], "n_timesteps": 240,
        "eval_interval": 80, "variants": {"v": changes}, "final_tracks": ["g-track-1"], **more,
    }  # fmt: skip
    file = tmp_path / "study.yml"
    file.write_text(yaml.safe_dump(said))
    return read_study(file).trials[0]


def killed_after_every_slice(trial, folder):
    """Goes on from each checkpoint in a new object, as a new process would."""
    checkpoint, number = None, 0

    class Killed(Exception):
        pass

    while True:
        training = Training(trial, checkpoint)
        th.rand(3)  # whatever else the process did
        np.random.default_rng().random()
        new = folder / f"checkpoint{number}"

        def save_and_die(training=training, new=new):
            new.mkdir()
            training.save(new)
            raise Killed

        try:
            training.run(save_and_die)
        except Killed:
            checkpoint, number = new, number + 1
            if training.rows[-1]["decisions"] >= trial.budget:
                return training, checkpoint
        finally:
            training.close()


def without_clocks(rows):
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in rows]


def weights(model):
    return {name: value.numpy().tobytes() for name, value in model.policy.state_dict().items()}


@pytest.mark.parametrize("changes", CASES.values(), ids=CASES)
def test_a_training_that_is_killed_after_every_evaluation_learns_the_same(tmp_path, changes):
    wanted = trial(tmp_path, {**TINY, **changes})
    undisturbed = Training(wanted)
    undisturbed.run(lambda: None)
    undisturbed.close()
    resumed, _ = killed_after_every_slice(wanted, tmp_path)
    assert [row["decisions"] for row in undisturbed.rows] == [80, 160, 240]
    assert len({row["return"] for row in undisturbed.rows}) == 3  # each drives what was learned
    assert without_clocks(resumed.rows) == without_clocks(undisturbed.rows)
    assert weights(resumed.model) == weights(undisturbed.model)
    assert resumed.model._current_progress_remaining == 0.0  # schedules fall over the whole budget
    for name in ("observations", "actions", "rewards", "dones", "timeouts"):
        rings = (getattr(t.model.replay_buffer, name) for t in (resumed, undisturbed))
        np.testing.assert_array_equal(*rings)


BEHIND_WRAPPERS = {
    **PPO,
    "env_wrapper": {"sb3_contrib.common.wrappers.TimeFeatureWrapper": {"max_steps": 500}},
    "normalize": {"norm_obs": True, "norm_reward": False},
    "frame_stack": 3,
}  # fmt: skip


ADAPTIVE = {
    **PPO,
    "n_envs": 4,
    "callback": {
        "sb3_torcs.callbacks.RandomStartCallback": {"speed": 80.0, "hard": 1.0},
        "sb3_torcs.callbacks.adapting.AdaptiveLearningRateCallback": {"kl": 0.1},
    },
}  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [PPO, BEHIND_WRAPPERS, ADAPTIVE],
    ids=["bare", "behind wrappers", "hard starts and a rate that adapts"],
)
def test_an_algorithm_without_a_replay_buffer_goes_on_the_same(tmp_path, changes):
    wanted = trial(tmp_path, changes)
    undisturbed = Training(wanted)
    undisturbed.run(lambda: None)
    undisturbed.close()
    resumed, _ = killed_after_every_slice(wanted, tmp_path)
    assert without_clocks(resumed.rows) == without_clocks(undisturbed.rows)
    assert weights(resumed.model) == weights(undisturbed.model)


def test_a_callback_that_stops_the_training_is_told(tmp_path):
    path = "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"
    changes = {**TINY, "callback": {path: {"max_episodes": 1}}}
    training = Training(trial(tmp_path, changes, n_timesteps=5000, eval_interval=5000))
    with pytest.raises(
        StudyError, match=r"a callback stopped the training at .* of 5000 timesteps"
    ):
        training.run(lambda: None)
    training.close()


@pytest.mark.parametrize("changes", [{}, {"normalize": {"norm_obs": True}}], ids=["", "normalized"])
def test_the_best_model_is_one_that_the_command_and_stock_sb3_drive(tmp_path, capsys, changes):
    wanted = trial(tmp_path, {**TINY, **changes, "n_steps": 3})
    training, checkpoint = killed_after_every_slice(wanted, tmp_path)
    (kept,) = [row for row in training.rows if row["kept"]][-1:]
    final = final_row(wanted, checkpoint / "best_model.zip", "g-track-1", kept)
    assert (final["phase"], final["decisions"]) == ("final", kept["decisions"])
    words = ["evaluate", str(checkpoint), "--track", "g-track-1", "--json"]
    assert main(words) == 0
    (episode,) = json.loads(capsys.readouterr().out)["episodes"]
    assert round(episode["distance"], 3) == final["distance_m"]
    assert episode["return"] == final["return"]
    if not changes:
        again = final_row(wanted, checkpoint / "best_model.zip", "aalborg", kept)
        same = ("laps", "distance_m", "end", "return")
        assert [again[name] for name in same] == [kept[name] for name in same]


def test_evaluations_drive_one_car_of_several(tmp_path, monkeypatch):
    cars = ["car1-trb1", "car2-trb1"]
    built = []
    monkeypatch.setattr(
        "sb3_torcs.training.trial.race_environment",
        lambda env_id, env_kwargs, track, **_: built.append(env_kwargs["car"]) or 1 / 0,
    )
    wanted = trial(tmp_path, {"env_kwargs": {"car": cars}}, env="Torcs-v0")
    with pytest.raises(ZeroDivisionError):
        final_row(wanted, tmp_path / "best_model.zip", "aalborg", {"end": "laps"})
    race = Episode(1, [80.0], 2587.5, "laps", 0.0, 0.0)
    assert built == ["car1-trb1"]
    assert wanted.row("aalborg", race)["ladder"]


def test_the_model_that_is_kept_is_the_best_by_the_protocol(tmp_path, monkeypatch):
    """On its own track only; a later one has to be better, not as good."""

    def race(distance, times=()):
        end = "laps" if times else "off_track"
        return Episode(len(times), list(times), distance, end, 0.0, 0.0)

    drives = iter([race(50.0), race(40.0), race(60.0), race(9.0, [9, 8, 8]), race(9.0, [9, 9, 9])])
    monkeypatch.setattr(Training, "_drive", lambda self, track: [next(drives)])
    monkeypatch.setattr(Training, "_show", lambda self, races: None)
    training = Training(trial(tmp_path, TINY, n_timesteps=400))
    training.run(lambda: None)
    training.close()
    assert [row["kept"] for row in training.rows] == [True, False, True, True, False]
