"""Simulated worlds with known truth: trajectories, radars that see them, draws of hybrid models."""

from saltus.simulate.diffusion import DiffusionDraws, advance, simulate_diffusion
from saltus.simulate.hybrid import HybridDraws, simulate_hybrid
from saltus.simulate.motion import Leg, Motion, Trajectory, coordinated_turn, radar_paper_trajectory
from saltus.simulate.radar import Observations, Radar, observe

__all__ = [
    "DiffusionDraws",
    "HybridDraws",
    "Leg",
    "Motion",
    "Observations",
    "Radar",
    "Trajectory",
    "advance",
    "coordinated_turn",
    "observe",
    "radar_paper_trajectory",
    "simulate_diffusion",
    "simulate_hybrid",
]
