"""How matrices depend on chains: by a function's signature, by a table of labels, or by their shape.

    R = lambda radar_condition: radar_condition**2 * R0            # parameters without default name chains
    R = {"by": {"radar_condition": {"ok": R0, "jammed": 100 * R0}}}  # the same as a table (and in TOML)
    R = np.stack([R0, 100 * R0])                                   # one axis per chain, 1 where it does not matter

All three become arrays with one mode axis per chain of the model, (M1|1, ..., MC|1, *core).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from inspect import Parameter, signature
from itertools import product
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError
from saltus.models.chain import RESERVED, Chain
from saltus.models.checks import FloatArray, numbers, same

__all__ = ["Bound", "Matrix", "TimeDependent", "fixed", "is_fixed", "resolve"]


@dataclass(frozen=True, slots=True, eq=False)
class TimeDependent:
    """A matrix function that also asks for `t` or `dt`: called when the model is compiled."""

    function: Callable[..., npt.ArrayLike] | None  # None while a table is being read
    words: tuple[str, ...]  # reserved words it asks for
    chains: tuple[Chain, ...]  # chains it asks for
    axes: tuple[int, ...]  # sizes of the mode axes, 1 for the other chains
    core: tuple[int, ...] | int
    what: str

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def at(self, t: FloatArray | None, dt: FloatArray) -> FloatArray:
        """Evaluate at interval ends t (T,) and lengths dt (T,): (T, M1|1, ..., MC|1, *core)."""
        if t is None and "t" in self.words:
            raise ModelError(f"{self.what} depends on t: compile the model with times=.")
        end = np.zeros_like(dt) if t is None else t
        asked = np.stack([{"t": end, "dt": dt}[word] for word in self.words], axis=-1)
        rows, which = np.unique(asked, axis=0, return_inverse=True)
        tables = []
        for row in rows:
            words = dict(zip(self.words, map(float, row), strict=True))
            tables.append(_table(_calling(self.function, self.chains, words), self))
        return np.stack(tables)[which.reshape(-1)]


Matrix: TypeAlias = npt.ArrayLike | Callable[..., npt.ArrayLike] | Mapping[str, object] | TimeDependent
Bound: TypeAlias = FloatArray | TimeDependent


def is_fixed(value: Matrix | None) -> bool:
    """Whether a value is plain numbers: neither a function, nor a table, nor absent."""
    return value is not None and not callable(value) and not isinstance(value, Mapping | TimeDependent)


def fixed(value: Matrix | None, what: str) -> FloatArray:
    """Return the array of a bound value.

    Raises:
        ModelError: the value still depends on chains or time.
    """
    if not is_fixed(value):
        raise ModelError(f"{what} depends on chains or time: put it into a HybridModel, and compile that.")
    return np.asarray(value)


def resolve(
    value: Matrix,
    chains: Sequence[Chain],
    what: str,
    core: tuple[int, ...] | int,
    words: tuple[str, ...] = (),
) -> Bound:
    """Turn a value in any of its three forms into an array with mode axes.

    Args:
        value: numbers, a function, or a table `{"by": {chain: {label: value}}}` (which may nest).
        chains: the chains of the model, in order.
        what: how messages name the value.
        core: number of axes of one matrix, or its shape, to which scalars and lower axes then broadcast.
        words: reserved words a function may ask for here.

    Returns:
        (M1|1, ..., MC|1, *core), or a TimeDependent when the function asks for `t` or `dt`.

    Raises:
        ModelError: unknown chain or label, unequal shapes, or axes that do not fit the chains.
    """
    if isinstance(value, TimeDependent):
        return value
    if isinstance(value, Mapping):
        names = _table_chains(value, chains, what)
        return _table(_looking_up(value), _spec(None, names, chains, what, core))
    if not callable(value):
        return _mode_axes(numbers(value, what), chains, what, core)
    asked = _parameters(value, what)
    unknown = [name for name in asked if name not in RESERVED and name not in [c.name for c in chains]]
    if unknown:
        known = ", ".join(c.name for c in chains) or "none"
        raise ModelError(
            f"{what} asks for {unknown[0]!r}, which is no chain of this model. Chains: {known}; "
            f"reserved words: {', '.join(RESERVED)}.\nGive other parameters a default value."
        )
    refused = [name for name in asked if name in RESERVED and name not in words]
    if refused:
        allowed = f"chains and {', '.join(words)}" if words else "chains only"
        raise ModelError(f"{what} asks for {refused[0]!r}, but here a matrix may depend on {allowed}.")
    spec = _spec(value, asked, chains, what, core)
    return spec if spec.words else _table(_calling(value, spec.chains, {}), spec)


def _spec(
    function: Callable[..., npt.ArrayLike] | None,
    asked: Sequence[str],
    chains: Sequence[Chain],
    what: str,
    core: tuple[int, ...] | int,
) -> TimeDependent:
    used = tuple(c for c in chains if c.name in asked)
    axes = tuple(len(c) if c.name in asked else 1 for c in chains)
    return TimeDependent(function, tuple(w for w in RESERVED if w in asked), used, axes, core, what)


def _calling(
    function: Callable[..., npt.ArrayLike] | None, chains: Sequence[Chain], words: Mapping[str, float]
) -> Callable[[Mapping[str, str]], object]:
    """Evaluate a function at labels: it receives the states' values, and the reserved words it asked for."""
    if function is None:
        raise TypeError("a table has no function to call")
    values = {c.name: dict(zip(c.labels, c.values, strict=True)) for c in chains}
    return lambda labels: function(**{name: values[name][label] for name, label in labels.items()}, **words)


def _looking_up(table: Mapping[str, object]) -> Callable[[Mapping[str, str]], object]:
    """Evaluate a table at labels, level by level."""

    def value_at(labels: Mapping[str, str]) -> object:
        value: object = table
        while isinstance(value, Mapping):
            ((name, branches),) = value["by"].items()
            value = branches[labels[name]]
        return value

    return value_at


def _table(value_at: Callable[[Mapping[str, str]], object], spec: TimeDependent) -> FloatArray:
    """Evaluate once per combination of states and stack the results along the mode axes."""
    leaves: list[FloatArray] = []
    for combination in product(*(c.labels for c in spec.chains)):
        labels = {c.name: label for c, label in zip(spec.chains, combination, strict=True)}
        where = ", ".join(f"{name}={label}" for name, label in labels.items())
        named = f"{spec.what} at {where}" if where else spec.what
        leaves.append(_core(numbers(value_at(labels), named), named, spec.core))
        if leaves[-1].shape != leaves[0].shape:
            raise ModelError(
                f"{named} has shape {leaves[-1].shape}, but {leaves[0].shape} for the first combination.\n"
                "Every mode needs the same shape."
            )
    table = np.stack(leaves).reshape(*spec.axes, *leaves[0].shape)
    table.flags.writeable = False
    return table


def _core(array: FloatArray, what: str, core: tuple[int, ...] | int) -> FloatArray:
    if isinstance(core, int):
        if array.ndim != core:
            noun = "a matrix (2 axes)" if core == 2 else f"an array of {core} axes"
            raise ModelError(f"{what} must be {noun}, got shape {array.shape}.")
        return array
    try:
        return np.broadcast_to(array, core)
    except ValueError:
        raise ModelError(f"{what} must be a number or have shape {core}, got shape {array.shape}.") from None


def _mode_axes(array: FloatArray, chains: Sequence[Chain], what: str, core: tuple[int, ...] | int) -> FloatArray:
    n_core = core if isinstance(core, int) else len(core)
    if array.ndim <= n_core and (array.ndim == n_core or not isinstance(core, int)):
        array = _core(array, what, core)
        return array.reshape((*(1,) * len(chains), *array.shape))
    expected = [f"{len(c)} or 1 ({c.name})" for c in chains]
    fits = array.ndim == n_core + len(chains) and all(
        size in (1, len(c)) for size, c in zip(array.shape, chains, strict=False)
    )
    if not fits:
        axes = ", ".join(expected)
        raise ModelError(
            f"{what} has shape {array.shape}; expected {n_core} axes"
            + (f", or one mode axis per chain before them: ({axes}, ...)" if chains else " (no chains)")
            + ".\nGive axes of length 1 to chains it does not depend on."
        )
    if not isinstance(core, int):
        array = np.broadcast_to(array, (*array.shape[: len(chains)], *core))
    return array


def _parameters(function: Callable[..., object], what: str) -> list[str]:
    plain = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    try:
        parameters = list(signature(function).parameters.values())
        readable = all(p.kind in plain for p in parameters)
    except (TypeError, ValueError):  # a builtin without a signature
        readable = False
    if not readable:
        raise ModelError(
            f"{what} must be a function with plain parameters named after chains, for instance "
            "lambda manoeuvre: ...; *args, **kwargs and positional-only parameters say nothing."
        )
    return [p.name for p in parameters if p.default is Parameter.empty]


def _table_chains(table: Mapping[str, object], chains: Sequence[Chain], what: str) -> list[str]:
    """Names of the chains a table depends on, after checking names and labels at every level."""
    by = table.get("by")
    if set(table) != {"by"} or not isinstance(by, Mapping) or len(by) != 1:
        raise ModelError(
            f"{what}: a table must read {{'by': {{chain: {{label: value, ...}}}}}}, one chain per level; "
            f"got keys {', '.join(map(str, table)) or 'none'}."
        )
    ((name, branches),) = by.items()
    chain = next((c for c in chains if c.name == name), None)
    if chain is None:
        known = ", ".join(c.name for c in chains) or "none"
        raise ModelError(f"{what} depends on {name!r}, which is no chain of this model. Chains: {known}.")
    if not isinstance(branches, Mapping) or set(branches) != set(chain.labels):
        got = ", ".join(map(str, branches)) if isinstance(branches, Mapping) else repr(branches)
        raise ModelError(
            f"{what}: the table for chain {name!r} needs one value for each of "
            f"{', '.join(chain.labels)}; got {got or 'none'}."
        )
    names = [str(name)]
    for branch in branches.values():
        if isinstance(branch, Mapping):
            names.extend(n for n in _table_chains(branch, chains, what) if n not in names)
    return names
