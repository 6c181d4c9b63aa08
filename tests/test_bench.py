import pytest

from sb3_torcs import bench


def test_every_figure_is_measured_once_or_empty(monkeypatch):
    """The keys are what other tools read."""
    monkeypatch.setattr(bench, "RESETS", 2)
    stages = bench.stages(0.01)
    figures = stages["resets"]()
    assert list(figures) == ["lite_reset_ms"]
    assert len(set(bench.KEYS)) == len(bench.KEYS) == 15


def test_the_environments_are_measured_in_the_same_run(monkeypatch):
    monkeypatch.setattr(bench, "TICKS_PER_TURN", 50)
    monkeypatch.setattr(bench, "RACETRACK_STEPS_PER_TURN", 2)
    figures = bench.environments(0.0001)
    assert list(figures) == ["lite_ticks_per_s", "racetrack_v1_steps_per_s"]
    assert min(figures.values()) > 0.0


def test_the_measured_actions_keep_the_car_moving(monkeypatch):
    """A car that stands is cheaper than one that drives."""
    monkeypatch.setattr(bench, "TICKS_PER_TURN", 500)
    env = bench.gym.make(bench.LITE, action_repeat=1)
    actions = bench._scripted_actions(env)
    env.reset(seed=0)
    speeds = [env.step(action)[4]["car"].speed_x for action in actions]
    env.close()
    assert len(actions) == 500
    assert speeds[-1] > 10.0


@pytest.mark.slow
def test_environment_and_callbacks_are_a_small_part_of_a_training_step():
    """Whoever trains waits for the networks, not for the simulator."""
    share = bench.training_share(100)["training_env_share"]
    assert 0.0 < share <= 0.1
