"""Your own reward: by weights, or by any code at all."""

import argparse
from typing import Any

import gymnasium as gym
from stable_baselines3 import DDPG
from stable_baselines3.common.monitor import Monitor

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.policies import SplitHeadPolicy

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=20_000)
args = parser.parse_args()

# The terms are those of sb3_torcs.rewards.TERMS, each per second; info["reward_terms"] shows what
# each of them gave. `scale` multiplies all of them, `crash` is added when an episode ends badly.
WEIGHTS = {"progress": 1.0, "pedals": -5.0, "scale": 0.1, "crash": -1.0}


class GentleSteering(gym.Wrapper):
    """Costs a little whenever the steering wheel moves: what no term says, a wrapper can."""

    def __init__(self, env: gym.Env, cost: float = 0.05) -> None:
        super().__init__(env)
        self.cost = cost  # [-] per full turn of the wheel, from lock to centre
        self.steering = 0.0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.steering = 0.0
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        moved = abs(float(action[0]) - self.steering)
        self.steering = float(action[0])
        return observation, float(reward) - self.cost * moved, terminated, truncated, info


env = Monitor(GentleSteering(gym.make("TorcsLite-v0", track="aalborg", reward=WEIGHTS)))
model = DDPG(SplitHeadPolicy, env, learning_starts=100, batch_size=64, device="cpu", seed=0)
model.learn(args.timesteps)
returns = env.get_episode_rewards()
best = max(returns, default=float("nan"))
print(f"{len(returns)} episodes; the best return by this reward was {best:.2f}")
