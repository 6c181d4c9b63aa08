"""The protocol of evaluations, the ladder of yardsticks, and watching who drives."""

from sb3_torcs.agents.rollout import drive
from sb3_torcs.evaluation.protocol import Episode, evaluate, merit, race_environment

__all__ = ["Episode", "drive", "evaluate", "merit", "race_environment"]
