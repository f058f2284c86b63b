"""Faults put into real plots: how well `saltus track` finds them, and what they cost."""

from saltus.injection.command import study_faults

__all__ = ["study_faults"]
