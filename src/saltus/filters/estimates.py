"""The history a filter returns."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from saltus.decisions import Decision, decide
from saltus.errors import ModelError
from saltus.models.findings import Finding, per_interval
from saltus.models.hybrid import HybridModel
from saltus.shapes import Float

__all__ = ["Estimates", "allocate", "described"]


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """What was believed after each measurement, one row per measurement time.

    `C` chains of sizes M1 ... MC, `*batch` leading axes, T rows, n states.

    Attributes:
        probs: P(modes | z_1..z_k), (*batch, T, M1, ..., MC).
        mean: E[x_k | z_1..z_k], (*batch, T, n).
        cov: its covariance, spread of the modes included, (*batch, T, n, n).
        log_likelihood: log f(z_k | z_1..z_{k-1}) in nats, (*batch, T); 0 for a row without measurement. With
            keep="last" it still has every row.
        log_likelihood_start: log f of what the start was conditioned on, (*batch,); 0 where there is no such thing.
        nis: nu' S^-1 nu of the mixture's innovation, (*batch, T); chi-square with n_observed degrees of freedom
            when the model is right and one mode dominates.
        n_observed: number of components measured, (*batch, T).
        mode_means, mode_covs: per mode, (*batch, T, M1, ..., MC, n[, n]); None unless per_mode.
        error: the filter's own error estimate (reference filters), else None: how far the mean may be from the exact
            one, in posterior standard deviations, (*batch, T).
        effective: share of the particles that count after each measurement (particle filters), else None.
        lost: at most how many nats were thrown away when histories of modes were merged or dropped before each row's
            measurement (`saltus.filters.merging`), (*batch, T): of `exact_filter`, and of `IMM(model).run` but for
            coloured noise; else None. The more, the farther the mean may be from the optimum.
        pairs: of smoothers: P(state i one row before, j now | all measurements used) of each chain,
            (*batch, T, Mc, Mc), row 0 from the prior; else None.
        chain_probs: of smoothers: law of each chain by its pairs, (*batch, T, Mc), free of the last mixing's error and
            so better than the marginals of `probs`; else None.
        chains: names of the chains, in axis order.
        times: times of the rows in s, or None.
        findings: what is doubtful: about the model with these times, as `HybridModel.check` says it; `merging` that
            throws away much; measurements that are `unexplained`.
    """

    probs: Float[np.ndarray, "*modes"]
    mean: Float[np.ndarray, "*rows n"]
    cov: Float[np.ndarray, "*rows n n"]
    log_likelihood: Float[np.ndarray, "*all_rows"]
    log_likelihood_start: Float[np.ndarray, "*batch"]
    nis: Float[np.ndarray, "*rows"]
    n_observed: Float[np.ndarray, "*rows"]
    mode_means: Float[np.ndarray, "*modes n"] | None = None
    mode_covs: Float[np.ndarray, "*modes n n"] | None = None
    error: Float[np.ndarray, "*rows"] | None = None
    effective: Float[np.ndarray, "*rows"] | None = None
    lost: Float[np.ndarray, "*rows"] | None = None
    pairs: tuple[Float[np.ndarray, "..."], ...] | None = None
    chain_probs: tuple[Float[np.ndarray, "..."], ...] | None = None
    chains: tuple[str, ...] = ()
    times: Float[np.ndarray, " t"] | None = None
    findings: tuple[Finding, ...] = ()

    def prob(self, *chains: str | int) -> Float[np.ndarray, "*rows_m"]:
        """Return the marginal probabilities of one chain, (*batch, T, M), or the joint ones of several.

        Args:
            chains: names, or positions among the chains; the axes of the result come in the order asked for.

        Raises:
            ModelError: no chain of that name, no chain at all, or one chain twice.
        """
        asked = [self._position(chain) for chain in chains]
        if not asked or len(set(asked)) < len(asked):
            raise ModelError(f"prob needs the name or position of each chain wanted, once; got {chains}.")
        first = self.mean.ndim - 1
        others = tuple(first + c for c in range(self._n_chains) if c not in asked)
        kept = sorted(asked)
        summed = self.probs.sum(axis=others)
        return np.asarray(np.moveaxis(summed, [first + kept.index(c) for c in asked], range(first, summed.ndim)))

    def decide(
        self, *, alpha: npt.ArrayLike = 1.0, beta: npt.ArrayLike = 0.0, scale: npt.ArrayLike | None = None
    ) -> Decision:
        """Decide on a mode and an estimate for every row: see `saltus.decide`.

        Raises:
            ModelError: the modes' means and covariances were not kept, or an argument does not fit.
        """
        if self.mode_means is None or self.mode_covs is None:
            raise ModelError("a decision needs the mean and covariance of every mode: filter with per_mode=True.")
        modes = (self.probs, self.mode_means, self.mode_covs)
        return decide(*modes, alpha=alpha, beta=beta, scale=scale, n_chains=self._n_chains)

    @property
    def _n_chains(self) -> int:
        return self.probs.ndim - self.mean.ndim + 1

    def _position(self, chain: str | int) -> int:
        if isinstance(chain, str):
            if chain not in self.chains:
                raise ModelError(f"no chain named {chain!r}; the chains are {', '.join(self.chains) or 'unnamed'}.")
            return self.chains.index(chain)
        if not 0 <= chain < self._n_chains:
            raise ModelError(f"chain {chain} does not exist: there are {self._n_chains}, counted from 0.")
        return chain


def described(found: Estimates, model: HybridModel, times: Float[np.ndarray, " t"]) -> Estimates:
    """Add what the model and the times of the rows say of estimates: names, times, findings."""
    names = tuple(chain.name for chain in model.chains)
    return replace(found, chains=names, times=times, findings=(*found.findings, *per_interval(model, times)))


def allocate(
    batch: tuple[int, ...], kept: int, n_steps: int, sizes: tuple[int, ...], n: int, per_mode: bool
) -> Estimates:
    """Make room for estimates without errors: rows to fill for runs of n_steps, `kept` of them with moments."""
    # Arrays apart: the allocator gives the smaller ones out again without new pages, which one large piece forgoes.
    rows = (*batch, kept)
    return Estimates(
        probs=np.empty((*rows, *sizes)),
        mean=np.empty((*rows, n)),
        cov=np.empty((*rows, n, n)),
        log_likelihood=np.empty((*batch, n_steps)),
        log_likelihood_start=np.zeros(batch),
        nis=np.empty(rows),
        n_observed=np.empty(rows),
        mode_means=np.empty((*rows, *sizes, n)) if per_mode else None,
        mode_covs=np.empty((*rows, *sizes, n, n)) if per_mode else None,
    )
