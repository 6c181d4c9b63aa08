"""Print how large the project is. ``python tools/size.py`` (counting the tests takes seconds)."""

import inspect
import subprocess
import sys
from pathlib import Path

import yaml

import sb3_torcs.callbacks
from sb3_torcs.agents.models import shipped_agents
from sb3_torcs.cli import VERBS
from sb3_torcs.envs.torcs import TorcsEnv

ROOT = Path(__file__).parent.parent
LIMITS = {  # by the names of what counts
    "lines of Python in sb3_torcs/": 41_500,
    "lines of Python in tests/": 30_000,
    "words in docs/ and README.md": 66_000,
}


def lines(*patterns: str) -> int:
    """Lines in files whose paths match."""
    return sum(text.count("\n") for text in texts(*patterns))


def words(*patterns: str) -> int:
    """Words in files whose paths match."""
    return sum(len(text.split()) for text in texts(*patterns))


def texts(*patterns: str) -> list[str]:
    """The contents of files whose paths match."""
    return [path.read_text("utf-8") for pattern in patterns for path in sorted(ROOT.glob(pattern))]


def arguments() -> int:
    """Keyword arguments of ``Torcs-v0``."""
    kinds = [p.kind for p in inspect.signature(TorcsEnv.__init__).parameters.values()]
    return kinds.count(inspect.Parameter.KEYWORD_ONLY)


def entries() -> int:
    """Blocks of the hyperparameter files."""
    return sum(len(yaml.safe_load(text)) for text in texts("zoo_configs/*.yml"))


def callbacks() -> int:
    """Callbacks that users name."""
    return sum(name.endswith("Callback") for name in sb3_torcs.callbacks.__all__)


def tests() -> int:
    """Tests that ``make test`` collects."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "--quiet", "--no-header"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return sum("::" in line for line in done.stdout.splitlines())


COUNTS = {
    "lines of Python in sb3_torcs/": lambda: lines("sb3_torcs/**/*.py"),
    "lines of C++": lambda: lines("sb3_torcs/native/**/*.cpp", "sb3_torcs/native/**/*.h"),
    "lines of Python in tests/": lambda: lines("tests/*.py"),
    "words in docs/ and README.md": lambda: words("docs/**/*.md", "README.md"),
    "words in README.md": lambda: words("README.md"),
    "arguments of Torcs-v0": arguments,
    "verbs": lambda: len(VERBS),
    "agents": lambda: len(shipped_agents()),
    "entries": entries,
    "callbacks": callbacks,
    "tests collected": tests,
}


if __name__ == "__main__":
    for name, count in COUNTS.items():
        print(f"{count():7,d}  {name}")
