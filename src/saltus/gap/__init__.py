"""How far the fast filter is from the optimum, for a model of the user's own."""

from saltus.gap.compare import optimality_gap
from saltus.gap.model_file import Scenario, load_scenario
from saltus.gap.result import Candidate, Figure, Gap

__all__ = ["Candidate", "Figure", "Gap", "Scenario", "load_scenario", "optimality_gap"]
