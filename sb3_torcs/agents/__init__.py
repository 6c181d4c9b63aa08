"""Drivers: saved models, the scripted driver and robots. The folders hold the shipped agents."""

from sb3_torcs.agents.models import driver_record, load_driver, shipped_agents
from sb3_torcs.agents.scripted import ScriptedDriver

__all__ = ["ScriptedDriver", "driver_record", "load_driver", "shipped_agents"]
