"""Gaussian laws of the state, possibly different per mode."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from saltus.errors import ModelError
from saltus.models.chain import Chain
from saltus.models.checks import covariance, numbers, same
from saltus.models.dependence import Matrix, fixed, is_fixed, resolve

__all__ = ["Gaussian"]


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """A Gaussian law, possibly different per mode.

    Args:
        mean: (n,).
        cov: (n, n).
        time: when it holds, s; absent means at the first measurement.

    Raises:
        ModelError: shapes do not fit, or cov is no covariance.
    """

    mean: Matrix
    cov: Matrix
    time: float | None = None

    def __post_init__(self) -> None:
        if is_fixed(self.mean):
            object.__setattr__(self, "mean", numbers(self.mean, "Gaussian mean"))
        if is_fixed(self.cov):
            object.__setattr__(self, "cov", covariance(self.cov, "Gaussian cov"))
        if is_fixed(self.mean) and is_fixed(self.cov):
            mean, cov = fixed(self.mean, "Gaussian mean"), fixed(self.cov, "Gaussian cov")
            if mean.shape[-1:] != cov.shape[-1:]:
                raise ModelError(f"Gaussian mean {mean.shape} and cov {cov.shape} differ in dimension.")

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def bind(self, chains: Sequence[Chain]) -> "Gaussian":
        """Replace functions and tables by arrays with one mode axis per chain."""
        mean = resolve(self.mean, chains, "Gaussian mean", 1)
        return replace(self, mean=mean, cov=resolve(self.cov, chains, "Gaussian cov", 2))
