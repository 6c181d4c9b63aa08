"""Train DDPG on TorcsLite-v0 with plain Stable-Baselines3."""

import argparse

from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

import sb3_torcs  # noqa: F401  (registers the environments)
from sb3_torcs.callbacks import (
    NoiseCallback,
    NoiseDecayCallback,
    RandomStartCallback,
    RecordCallback,
)
from sb3_torcs.policies import SplitHeadPolicy

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=120_000)
parser.add_argument("--folder", default="logs/example")
args = parser.parse_args()

env = make_vec_env("TorcsLite-v0", n_envs=4, env_kwargs={"track": "aalborg"})
eval_env = make_vec_env("TorcsLite-v0", env_kwargs={"track": "aalborg"})
policy_kwargs = {"net_arch": [128, 128], "layer_norm": True, "n_critics": 2, "critic_lr_scale": 2.0}
model = DDPG(
    SplitHeadPolicy,
    env,
    learning_rate=5e-4,
    learning_starts=1000,
    batch_size=64,
    gamma=0.98,
    gradient_steps=2,
    policy_kwargs={**policy_kwargs, "head_bias": [0.0, 0.0, -1.0]},  # little brake to begin with
    device="cpu",
    seed=0,
)
pedal = [0.0, 1.0, 0.3]  # mu, theta [1/s], sigma
callbacks = [
    RecordCallback(),  # so that all commands drive the model as it was trained, without --trust
    RandomStartCallback(),  # an episode may begin anywhere, so that every corner is practised
    NoiseCallback(kind="ou", dt=0.1, steering=[0.0, 1.0, 0.2], throttle=pedal, brake=pedal),
    NoiseDecayCallback(timesteps=int(0.7 * args.timesteps), floor=0.2),
    EvalCallback(eval_env, eval_freq=1500, n_eval_episodes=1, best_model_save_path=args.folder),
]
model.learn(args.timesteps, callback=callbacks)
model.save(f"{args.folder}/model")
print(f"saved {args.folder}/model.zip; drive it: python examples/evaluate.py {args.folder}/model")
