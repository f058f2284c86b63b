"""Simulated worlds with known truth: trajectories, radars that see them, draws of hybrid models."""

from saltus.simulate.motion import Leg, Motion, Trajectory, coordinated_turn, radar_paper_trajectory

__all__ = ["Leg", "Motion", "Trajectory", "coordinated_turn", "radar_paper_trajectory"]
