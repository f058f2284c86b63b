"""The report: one self-contained HTML page of tracks, plots, noise and counts."""

from saltus.report.page import write_report

__all__ = ["write_report"]
