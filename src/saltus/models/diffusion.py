"""Diffusions whose drift, noise and place change at random: switching stochastic differential equations.

The general model behind the reference filters and the moment filter. What depends on the state is a function of it,
vectorised over leading axes; what does not is a number or an array.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.checks import FloatArray, covariance, numbers, same
from saltus.shapes import Float

__all__ = ["Field", "SwitchingSDE", "field_value", "probe_states"]

_MEND = (  # by the number of axes at one state
    "A rate is one number at each state: write it of components, as y[..., 0].",
    "Write y[..., 0] for the first component, and np.stack([...], axis=-1) for several results; a constant is (n,).",
    "A matrix has one row per component: a number stands for that number times the unit matrix, a function of one "
    "component and one noise returns b[..., None].",
)

# A function of states (..., n) with any leading axes, or a constant.
Field: TypeAlias = Callable[[FloatArray], npt.ArrayLike] | npt.ArrayLike


@dataclass(frozen=True, slots=True, eq=False)
class SwitchingSDE:
    """A diffusion with S modes ("structures") between which it switches at state-dependent rates.

    dY = a_l(Y) dt + b_l(Y) dW  while the mode is l;   P(switch r -> l in dt) = nu_rl(Y) dt

    At a switch the state is kept, or drawn anew from a Gaussian that does not depend on where it was.

    Args:
        drift: one per mode: function (..., n) -> (..., n), or constant (n,); state unit / s.
        diffusion: one per mode: function (..., n) -> (..., n, w), constant (n, w), or a number, which stands for that
            number times the unit matrix; state unit / sqrt(s).
        intensity: rates of switching by (from, to): function (..., n) -> (...), or a number; 1/s. Absent pairs never
            switch.
        restore: (mean, cov) of the state just after a switch, by (from, to); absent or None: the state is kept.
        probs0: law of the mode at the start, (S,).
        mean0: mean of the state at the start, (n,) or per mode (S, n).
        cov0: its covariance, (n, n) or per mode (S, n, n).

    Raises:
        ModelError: shapes do not fit, a rate is negative, or a function is not vectorised.

    Source: moment-filter notes, sections 0 and 1.
    """

    drift: Sequence[Field]
    diffusion: Sequence[Field]
    intensity: Mapping[tuple[int, int], Field]
    restore: Mapping[tuple[int, int], tuple[npt.ArrayLike, npt.ArrayLike] | None] | None = None
    probs0: npt.ArrayLike = (1.0,)
    mean0: npt.ArrayLike = (0.0,)
    cov0: npt.ArrayLike = ((1.0,),)

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "probs0", _law(self.probs0))
        put(self, "mean0", numbers(self.mean0, "mean0"))
        if np.ndim(self.mean0) == 0:
            raise ModelError(f"mean0 must be (n,), or (S, n) per mode, got {self.mean0}. Write [{self.mean0}].")
        put(self, "cov0", covariance(self.cov0, "cov0"))
        n_modes, n = self.n_modes, self.n_state
        _prior_fits("mean0", np.shape(self.mean0), n_modes, (n,))
        _prior_fits("cov0", np.shape(self.cov0), n_modes, (n, n))
        put(self, "drift", _fixed(self.drift, "drift", n_modes))
        put(self, "diffusion", _fixed(self.diffusion, "diffusion", n_modes))
        put(self, "intensity", _rates(self.intensity, n_modes))
        put(self, "restore", _restored(self.restore or {}, self.intensity, n))
        self._probe()

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    @property
    def n_modes(self) -> int:
        """Number of modes S."""
        return len(np.asarray(self.probs0))

    @property
    def n_state(self) -> int:
        """Dimension of the state n."""
        return int(np.shape(self.mean0)[-1])

    @property
    def switches(self) -> tuple[tuple[int, int], ...]:
        """The switches (from, to) that can happen."""
        return tuple(self.intensity)

    @property
    def means0(self) -> Float[np.ndarray, "s n"]:
        """Mean of the start per mode."""
        return np.broadcast_to(np.asarray(self.mean0), (self.n_modes, self.n_state))

    @property
    def covs0(self) -> Float[np.ndarray, "s n n"]:
        """Covariance of the start per mode."""
        return np.broadcast_to(np.asarray(self.cov0), (self.n_modes, self.n_state, self.n_state))

    def drift_at(self, mode: int, x: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead n"]:
        """Drift a of a mode at states (..., n)."""
        return field_value(self.drift[mode], x, (self.n_state,), f"drift[{mode}]")

    def diffusion_at(self, mode: int, x: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead n w"]:
        """Diffusion factor b of a mode at states (..., n)."""
        return field_value(self.diffusion[mode], x, (self.n_state, None), f"diffusion[{mode}]")

    def covariance_at(self, mode: int, x: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead n n"]:
        """B = b b' of a mode at states (..., n)."""
        if not callable(self.diffusion[mode]):
            b = self.diffusion_at(mode, self.means0[mode])
            return np.broadcast_to(b @ b.T, (*np.shape(x), self.n_state))
        b = self.diffusion_at(mode, x)
        return np.asarray(b @ b.swapaxes(-1, -2))

    def rate(self, switch: tuple[int, int], x: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead"]:
        """Rate of a switch (from, to) at states (..., n), 1/s; 0 for one that never happens.

        Raises:
            ModelError: the rate is negative somewhere.
        """
        rates = field_value(self.intensity.get(switch, 0.0), x, (), f"intensity[{switch}]")
        if rates.size and rates.min() < 0:
            at = np.reshape(x, (-1, self.n_state))[int(rates.argmin())]
            raise ModelError(
                f"intensity[{switch}] is {rates.min():g} per second at state {at}: rates must not be negative, "
                "wherever a filter may look.\n"
                "Give rates per second by (from, to), np.maximum(rate, 0.0) if need be; the exit rate is their sum and "
                "needs no entry."
            )
        return rates

    def exit_rate(self, mode: int, x: Float[np.ndarray, "*lead n"]) -> Float[np.ndarray, "*lead"]:
        """Rate at which a mode is left, 1/s."""
        total = np.zeros(np.shape(x)[:-1])
        for switch in self.switches:
            if switch[0] == mode:
                total = total + self.rate(switch, x)
        return np.asarray(total)

    def restored(self, switch: tuple[int, int]) -> tuple[FloatArray, FloatArray] | None:
        """Mean (n,) and covariance (n, n) just after a switch; None where the state is kept."""
        law = (self.restore or {}).get(switch)
        return None if law is None else (np.asarray(law[0]), np.asarray(law[1]))

    def _probe(self) -> None:
        """Call every function once, with two leading axes, and look at what it gives."""
        x = probe_states(self.means0, self.covs0)
        for mode in range(self.n_modes):
            self.drift_at(mode, x)
            self.diffusion_at(mode, x)
        for switch in self.switches:
            self.rate(switch, x)


def probe_states(means: Float[np.ndarray, "s n"], covs: Float[np.ndarray, "s n n"]) -> Float[np.ndarray, "s p n"]:
    """States where a description is tried: each mode's mean, and three standard deviations about it on each axis."""
    n = means.shape[-1]
    spread = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
    steps = np.concatenate([np.zeros((1, n)), *(c * np.eye(n) for c in (1.0, -1.0, 3.0, -3.0))])
    return np.asarray(means[:, None] + steps * spread[:, None])


def field_value(
    field: Field, x: Float[np.ndarray, "*lead n"], core: tuple[int | None, ...], what: str
) -> Float[np.ndarray, "..."]:
    """Value of a function or constant at states (..., n), of shape (..., *core); None in core leaves a size open.

    Raises:
        ModelError: another shape, numbers that are not finite, or a function that fails.
    """
    lead = np.shape(x)[:-1]
    if not callable(field):
        array = np.asarray(field)
        if array.ndim == 0 and len(core) == 2:
            array = array * np.eye(np.shape(x)[-1])
        _core_fits(array.shape, core, what)
        return np.broadcast_to(array, (*lead, *array.shape))
    try:
        array = np.asarray(field(x), dtype=np.float64)
    except (IndexError, TypeError, ValueError) as error:
        raise ModelError(
            f"{what} failed for states {np.shape(x)}: {error}\n"
            "It is called with many states at once: write y[..., 0] for the first component, np.where for branches."
        ) from error
    split = array.ndim - len(core)
    if array.shape[: max(split, 0)] != lead:
        wanted = (*lead, *("w" if size is None else size for size in core))
        raise ModelError(
            f"{what} returned shape {array.shape} for states {np.shape(x)}; it must keep leading axes: "
            f"{_shown(wanted)}.\n{_MEND[len(core)]}"
        )
    _core_fits(array.shape[split:], core, what)
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))[0][: len(lead)]
        raise ModelError(f"{what} is not finite at state {x[tuple(bad)]}; it must be defined on the whole space.")
    return array


def _core_fits(shape: tuple[int, ...], core: tuple[int | None, ...], what: str) -> None:
    if len(shape) != len(core) or any(want not in (None, have) for have, want in zip(shape, core, strict=True)):
        wanted = tuple("w" if size is None else size for size in core)
        raise ModelError(f"{what} has shape {shape}, but must have {_shown(wanted)} at one state.\n{_MEND[len(core)]}")


def _shown(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"


def _fixed(fields: Sequence[Field], what: str, n_modes: int) -> tuple[Field, ...]:
    if callable(fields) or np.ndim(np.asarray(fields, dtype=object)) == 0:
        raise ModelError(f"{what} must be a list with one entry per mode, got {fields!r}. Write [{what}] for one mode.")
    if len(fields) != n_modes:
        raise ModelError(f"{what} has {len(fields)} entries, but probs0 has {n_modes} modes; give one per mode.")
    return tuple(f if callable(f) else numbers(f, f"{what}[{i}]") for i, f in enumerate(fields))


def _law(probs: object) -> FloatArray:
    p = numbers(probs, "probs0")
    if p.ndim != 1 or not len(p) or p.min() < 0 or abs(p.sum() - 1) > 1e-8:
        raise ModelError(f"probs0 must be probabilities (S,) that sum to 1, got {p.tolist()}.")
    return p


def _prior_fits(what: str, shape: tuple[int, ...], n_modes: int, core: tuple[int, ...]) -> None:
    if shape not in (core, (n_modes, *core)):
        raise ModelError(f"{what} must have shape {core}, or {(n_modes, *core)} per mode, got {shape}.")


def _rates(given: Mapping[tuple[int, int], Field], n_modes: int) -> dict[tuple[int, int], Field]:
    if not isinstance(given, Mapping):
        raise ModelError(f"intensity must be a dictionary of rates by (from, to), as {{(0, 1): 0.3}}, got {given!r}.")
    for switch in given:
        _pair(switch, n_modes, "intensity")
    return {s: f if callable(f) else numbers(f, f"intensity[{s}]") for s, f in given.items()}


def _restored(
    given: Mapping[tuple[int, int], tuple[object, object] | None], rates: Mapping[tuple[int, int], Field], n: int
) -> dict[tuple[int, int], tuple[FloatArray, FloatArray]]:
    if not isinstance(given, Mapping):
        raise ModelError(f"restore must be a dictionary of (mean, cov) by (from, to), got {given!r}.")
    laws = {}
    for switch, law in given.items():
        if switch not in rates:
            raise ModelError(f"restore has {switch!r}, a switch without intensity. Those with one: {[*rates]}.")
        if law is None:
            continue
        if not isinstance(law, tuple | list) or len(law) != 2:
            raise ModelError(f"restore[{switch}] must be (mean, cov), or None where the state is kept, got {law!r}.")
        mean, cov = numbers(law[0], f"restore[{switch}] mean"), covariance(law[1], f"restore[{switch}] cov")
        if mean.shape != (n,) or cov.shape != (n, n):
            raise ModelError(f"restore[{switch}] must be a mean ({n},) and a covariance ({n}, {n}).")
        laws[switch] = (mean, cov)
    return laws


def _pair(switch: tuple[int, int], n_modes: int, what: str) -> None:
    fits = isinstance(switch, tuple) and len(switch) == 2 and switch[0] != switch[1]
    if not fits or not all(isinstance(i, int) and 0 <= i < n_modes for i in switch):
        raise ModelError(
            f"{what} has the key {switch!r}; keys are (from, to), two different modes of 0..{n_modes - 1}."
        )
