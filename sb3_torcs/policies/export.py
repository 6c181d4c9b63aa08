"""Export a driver as an ONNX graph, which runs without SB3, PyTorch and this package."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_torcs.errors import ModelMismatch, check_extras
from sb3_torcs.files import IN_A_FOLDER, atomic_file

__all__ = ["INPUT", "OUTPUT", "export_actor"]

INPUT, OUTPUT = "observation", "action"
"""Names in the graph: rows of float32 as the environment gives them, and as it takes them."""


class _Predicting(nn.Module):
    """
    A policy with the forward pass of ``predict(deterministic=True)``.

    :param policy: of Stable-Baselines3
    """

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        # Built anew, without the hooks of a noise and the optimizer's momentum.
        self.policy = type(policy)(**policy._get_constructor_parameters())
        self.policy.load_state_dict(policy.state_dict())
        self.policy.set_training_mode(False)

    def forward(self, observation: th.Tensor) -> th.Tensor:
        return self.policy._predict(observation, deterministic=True)


class _RawDriver(nn.Module):
    """
    A driver from the environment's observations to its actions.

    :param policy: of Stable-Baselines3
    :param statistics: of ``VecNormalize``, or ``None``
    """

    low: th.Tensor
    high: th.Tensor
    mean: th.Tensor
    deviation: th.Tensor

    def __init__(self, policy: BasePolicy, statistics: Any) -> None:
        super().__init__()
        exact = getattr(policy, "exact_driver", None)
        self.driver = _Predicting(policy) if exact is None else exact()
        self.squashed = policy.squash_output
        assert isinstance(policy.action_space, spaces.Box)
        self.register_buffer("low", th.as_tensor(policy.action_space.low))
        self.register_buffer("high", th.as_tensor(policy.action_space.high))
        self.clip = None if statistics is None else float(statistics.clip_obs)
        if statistics is not None:
            found = getattr(statistics, "obs_rms", statistics)
            deviation = np.sqrt(np.asarray(found.var, np.float64) + statistics.epsilon)
            self.register_buffer("mean", th.as_tensor(np.asarray(found.mean, np.float64)))
            self.register_buffer("deviation", th.as_tensor(deviation))

    def forward(self, observation: th.Tensor) -> th.Tensor:
        # All operations are in the order and precision of VecNormalize and BasePolicy.predict.
        if self.clip is not None:
            scaled = (observation.double() - self.mean) / self.deviation
            observation = scaled.clamp(-self.clip, self.clip).float()
        action: th.Tensor = self.driver(observation)
        if self.squashed:
            return self.low + 0.5 * (action + 1.0) * (self.high - self.low)
        return action.clamp(self.low, self.high)


def export_actor(model: Any, path: str | os.PathLike[str]) -> Path:
    """
    Export a driver as ONNX.

    The graph takes raw observations and gives actions in the environment's units: steering in
    [-1, 1], pedals in [0, 1]. It does what ``predict(deterministic=True)`` does, so it drives the
    average of the weights (``ema_decay``) and the mirror image (``symmetric``), if the policy does;
    the statistics of ``VecNormalize`` are in it, if the model learned with them.

    :param model: of Stable-Baselines3 or sb3-contrib, or what
        :func:`~sb3_torcs.agents.models.load_driver` loads
    :param path: of the file, e.g. ``"driver.onnx"``
    :return: the path
    :raises PackageMissing: if ``onnx`` or ``onnxscript`` is not installed
    :raises ModelMismatch: if the model cannot be written as one graph
    :raises OutputNotWritable: if the file cannot be written; no part of it is left behind
    """
    check_extras("an export", "onnx", "onnxscript")
    policy, statistics = _parts(model)
    _check_policy(policy, statistics)
    path = Path(path)
    with atomic_file(path, IN_A_FOLDER) as part:
        part.write_bytes(_graph(_RawDriver(policy, statistics), policy.observation_space))
    return path


def _parts(model: Any) -> tuple[Any, Any]:
    """Find the policy, and the statistics that normalise its observations."""
    statistics = getattr(model, "statistics", None)
    model = getattr(model, "model", model)
    if statistics is None and hasattr(model, "get_vec_normalize_env"):
        statistics = model.get_vec_normalize_env()
    normalized = statistics is not None and getattr(statistics, "norm_obs", True)
    return getattr(model, "policy", model), statistics if normalized else None


def _check_policy(policy: Any, statistics: Any) -> None:
    """Make sure that a policy is a function from one observation to one action."""
    name = type(policy).__name__
    if not isinstance(policy, BasePolicy) or not any(True for _ in policy.parameters()):
        raise ModelMismatch(
            f"{name} has no PyTorch network to export; pass a model of Stable-Baselines3 or "
            "sb3-contrib"
        )
    if hasattr(policy, "lstm_actor"):
        raise ModelMismatch(
            f"{name} remembers what it saw, and an export keeps no state; export a model whose "
            "policy has none, e.g. MlpPolicy"
        )
    for space in (policy.observation_space, policy.action_space):
        if not isinstance(space, spaces.Box):
            raise ModelMismatch(f"{name} is for {space}; an export needs spaces of numbers (Box)")
    found = getattr(statistics, "obs_rms", statistics)
    if found is not None and np.shape(found.mean) != policy.observation_space.shape:
        raise ModelMismatch(
            f"{name} sees stacked frames that are normalized one by one, and an export has no "
            "state for them; export a model that was trained without normalize or frame_stack"
        )


def _graph(driver: _RawDriver, space: spaces.Space[Any]) -> bytes:
    """Trace a driver with any number of observations at once."""
    driver = driver.cpu().eval().requires_grad_(False)
    assert isinstance(space, spaces.Box)
    example = th.zeros(2, *space.shape, dtype=th.as_tensor(space.low).dtype)
    try:
        with _for_tracing():
            program = th.onnx.export(
                driver, (example,), dynamo=True, verbose=False, input_names=[INPUT],
                output_names=[OUTPUT], dynamic_shapes=({0: th.export.Dim("n")},),
            )  # fmt: skip
    except RuntimeError as error:
        raise ModelMismatch(
            f"PyTorch cannot write {type(driver.driver).__name__} as ONNX: {error}"
        ) from error
    assert program is not None
    content: bytes = program.model_proto.SerializeToString()
    return content


@contextlib.contextmanager
def _for_tracing() -> Iterator[None]:
    """
    Disable checks that a graph cannot hold, and PyTorch's warnings about unneeded packages.

    Distributions check their arguments by looking at numbers, which a graph does not have yet.
    """
    distribution = th.distributions.Distribution
    logger = logging.getLogger("torch.onnx")
    checked, level = distribution._validate_args, logger.level
    logger.setLevel(logging.ERROR)
    distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        distribution.set_default_validate_args(checked)
        logger.setLevel(level)
