"""The file of a model, read as plain data, so that no code of it runs.

Stable-Baselines3 pickles a part of the file, and a pickle can run any code. This module only reads
its JSON and its weights, and limits the RAM that they take.
"""

from __future__ import annotations

import io
import json
import os
import pickletools
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_torcs.errors import ModelMismatch, ModelNotTrusted

if TYPE_CHECKING:
    import torch as th

__all__ = [
    "BROKEN",
    "IDLE",
    "VALUES",
    "check_finite",
    "find_saved",
    "learned_weights",
    "raise_mismatch",
    "saved_data",
    "saved_weights",
]

NEEDED_KEYS = ("observation_space", "action_space", "num_timesteps")

MIB = 2**20  # [bytes]
MAX_DATA = 16 * MIB  # of JSON; a policy's own is some 25 kB
MAX_WEIGHTS = 256 * MIB
MAX_INDEX = MIB  # of the names and shapes of all weights
MAX_PARTS = 10_000
MAX_WORDS = 400  # [characters] shown of the message of a library
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

PLAIN_GLOBALS = ("torch._utils _rebuild_tensor_v2", "collections OrderedDict")
"""What the index of weights names, beside types of storage; PyTorch itself would allow more."""

VALUES = ("value_net.", "mlp_extractor.value_net.")
"""The value function of PPO, which a training can go on from."""

IDLE = ("critic.", "critic_target.", "actor_target.", "critic_batch_norm", *VALUES)
"""Networks of a policy that only learning needs."""

BROKEN = (
    OSError, KeyError, TypeError, ValueError, AttributeError, EOFError, RuntimeError, MemoryError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What reading a damaged file raises; a RecursionError is a RuntimeError."""


@contextmanager
def raise_mismatch(what: str, hint: str) -> Iterator[None]:
    """
    Turn the errors that SB3 and pickle raise for a broken file into one class.

    :param what: the beginning of the message
    :param hint: what to do; "a model that is whole" follows
    """
    try:
        yield
    except (ModelMismatch, ModelNotTrusted):
        raise
    except Exception as error:
        why = " ".join(str(error).split())[:MAX_WORDS]
        raise ModelMismatch(
            f"{what} ({type(error).__name__}: {why}); {hint} a model that is whole"
        ) from error


def find_saved(path: str | Path) -> Path:
    """
    Find the file that ``model.save(path)`` has written: it adds the ending.

    :param path: with or without the ending
    :return: the file, or the path as it is if there is none
    """
    given = Path(os.path.expanduser(path))
    zipped = Path(f"{given}.zip")
    return zipped if not given.is_file() and zipped.is_file() else given


def saved_data(model: Path) -> dict[str, Any]:
    """
    Read the readable part of a saved model.

    :param model: the file
    :return: the algorithm's attributes; those that SB3 pickled are still texts
    :raises ModelMismatch: if the file is not a model
    """
    try:
        with zipfile.ZipFile(model) as archive:
            data: dict[str, Any] = dict(json.loads(_part(archive, "data", MAX_DATA)))
        for name in NEEDED_KEYS:
            data[name]
    except BROKEN as error:
        raise ModelMismatch(
            f"'{model}' is not a model that Stable-Baselines3 saved ({_words(error)}); give the "
            ".zip that a training saved"
        ) from error
    return data


def saved_weights(model: Path) -> dict[str, th.Tensor]:
    """
    Read the weights of a saved policy.

    :param model: the file
    :return: tensors by name, on the CPU
    :raises ModelMismatch: if they cannot be read, or if a weight of the actor is not finite
    """
    import torch as th

    what = f"'{model}' has no weights that can be read"
    with raise_mismatch(what, "give"):
        with zipfile.ZipFile(model) as archive:
            content = _part(archive, "policy.pth", MAX_WEIGHTS)
        _check_weights(content)
        weights = th.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        named = isinstance(weights, dict) and all(isinstance(name, str) for name in weights)
        if not named or not all(isinstance(part, th.Tensor) for part in weights.values()):
            raise ValueError("expected tensors by name")
    check_finite(model, weights)
    return dict(weights)


def learned_weights(model: Path) -> dict[str, th.Tensor]:
    """
    Read the weights of a policy without those that a shipped file leaves out, which are NaN there.

    :param model: the file
    :return: tensors by name; those of a learner may take the place of the others
    :raises ModelMismatch: as of :func:`saved_weights`
    """
    return {
        name: tensor
        for name, tensor in saved_weights(model).items()
        if not (name.startswith(IDLE) and bool(tensor.isnan().all()))
    }


def check_finite(model: Path, weights: dict[str, th.Tensor]) -> None:
    """
    Make sure that the weights of a policy are finite.

    :param model: the file, for the message
    :param weights: tensors by name
    :raises ModelMismatch: if a network that chooses actions has NaN or an infinity
    """
    import torch as th

    for name, tensor in weights.items():
        if not name.startswith(IDLE) and not bool(th.isfinite(tensor).all()):
            raise ModelMismatch(
                f"the weights '{name}' of '{model}' are not finite: its training has diverged; "
                "give a model that was saved before, e.g. best_model.zip of the same run"
            )


def _part(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """Unpack a part of a zip, unless it is too large."""
    if len(archive.infolist()) > MAX_PARTS:
        raise ValueError(f"{len(archive.infolist())} parts")
    info = archive.getinfo(name)
    if info.file_size > limit or info.compress_type not in COMPRESSIONS:
        raise ValueError(f"its part '{name}' unpacks to more than {limit // MIB} MiB, or oddly")
    return archive.read(info)


def _check_weights(content: bytes) -> None:
    """
    Make sure that weights are a file of ``torch.save`` with tensors by name.

    :param content: a zip of its own
    :raises ValueError: if they are more than that
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = archive.infolist()
        names = [info.filename for info in parts]
        if len(parts) > MAX_PARTS or len(set(names)) < len(names):
            raise ValueError("too many parts")
        # PyTorch does not compress, so the content is no larger than the file.
        if any(info.compress_type != zipfile.ZIP_STORED for info in parts):
            raise ValueError("compressed weights within the zip")
        (index,) = [name for name in names if name.endswith("data.pkl")]
        for op, argument, _ in pickletools.genops(_part(archive, index, MAX_INDEX)):
            if op.name in ("STACK_GLOBAL", "INST") or (
                op.name == "GLOBAL"
                and argument not in PLAIN_GLOBALS
                and not str(argument).endswith("Storage")
            ):
                raise ValueError(f"its weights name '{argument}'")


def _words(error: BaseException) -> str:
    """Return the message of an error, or its class if the message is empty."""
    if isinstance(error, RecursionError):
        return "its data nests too deep"
    return str(error) or type(error).__name__
