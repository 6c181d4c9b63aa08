"""``python -m sb3_torcs.rl_zoo SCRIPT …``: the RL Zoo's own scripts, with our environments.

It is for scripts without ``--gym-packages``, such as ``record_video``.
"""

from __future__ import annotations

import runpy
import sys
from importlib import util

import sb3_torcs  # noqa: F401  registers the environments
from sb3_torcs.errors import near_miss

__all__ = ["main"]

SCRIPTS = (
    "enjoy", "load_from_hub", "push_to_hub", "record_training", "record_video", "train",
)  # fmt: skip
"""What people run of it."""


def main() -> None:
    """Run the named script with the remaining arguments."""
    script = sys.argv[1] if len(sys.argv) > 1 else ""
    name = f"rl_zoo3.{script}"
    if not script.isidentifier() or util.find_spec(name) is None:
        hint = near_miss(script, SCRIPTS, f"it has {', '.join(SCRIPTS)}")
        usage = "python -m sb3_torcs.rl_zoo enjoy -h"
        sys.exit(f"the RL Zoo has no script '{script}'{hint}; type, e.g.: {usage}")
    sys.argv = [name, *sys.argv[2:]]
    runpy.run_module(name, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
