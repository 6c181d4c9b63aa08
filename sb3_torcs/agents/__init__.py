"""What drives: saved models, the scripted driver, robots; beside them the shipped agents."""

from sb3_torcs.agents.models import load_driver, shipped_agents
from sb3_torcs.agents.scripted import ScriptedDriver

__all__ = ["ScriptedDriver", "load_driver", "shipped_agents"]
