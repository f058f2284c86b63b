"""Tracking fed in pieces: a session with its setup, its journal and its checkpoints. It knows no file of reports."""

from saltus.engine.result import Result
from saltus.engine.session import Published, Session
from saltus.engine.setup import SensorSetup, Setup

__all__ = ["Published", "Result", "SensorSetup", "Session", "Setup"]
