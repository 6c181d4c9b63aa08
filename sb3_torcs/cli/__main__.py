"""``python -m sb3_torcs.cli``: the same command, also where its script is not installed."""

from __future__ import annotations

import sys

from sb3_torcs.cli import main

if __name__ == "__main__":
    sys.exit(main())
