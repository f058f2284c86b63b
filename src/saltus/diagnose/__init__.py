"""Diagnosis of real sensors: what their errors are like, estimated from data."""

from saltus.diagnose.fit import NoiseFit, Parameter, fit_noise

__all__ = ["NoiseFit", "Parameter", "fit_noise"]
