"""The page's tables: key figures, counts, noise, tracks, and whatever else the summary holds."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from saltus.report.columns import numbers, texts
from saltus.tracks.health import nis_interval

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["OUTSIDE", "Block", "blocks", "innovation_rows", "reason_rows", "show", "title"]

OUTSIDE = "outside time window"  # as assignments say it

_UNITS = {"m": "m", "deg": "°", "s": "s", "mps": "m/s", "mps2": "m/s²", "m2": "m²", "ft": "ft", "kt": "kt"} | {
    "nm": "NM",
    "hz": "Hz",
    "pct": "%",
    "percent": "%",
    "mb": "MB",
    "bytes": "bytes",
    "degps": "°/s",
    "nats": "nats",
    "perm2": "per m² and scan",
    "perrad": "per rad and scan",
}
_WORDS = {"sigma": "σ", "nis": "NIS", "dof": "degrees of freedom", "probs": "probabilities", "n": "number of"} | {
    "imm": "IMM",
    "sac": "SAC",
    "sic": "SIC",
    "utc": "UTC",
    "id": "id",
    "lsb": "LSB",
    "std": "standard deviation",
    "accel": "acceleration",
    "h": "horizontal",
    "v": "vertical",
    "xy": "position",
}


class Block(NamedTuple):
    """A table of the page: pairs when `columns` is empty."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class InnovationRow(NamedTuple):
    """One source's normalised innovations against their chi-square law."""

    source: str
    n: int
    mean: float  # mean NIS of two components
    low: float  # interval of that mean within which the noise fits
    high: float
    inside: float  # share within the 95 % point of chi-square
    verdict: str


def title(key: str) -> str:
    """Turn a key such as `sigma_range_m` into `σ range, m`."""
    words = key.split("_")
    unit = _UNITS.get(words[-1].lower()) if len(words) > 1 else None
    text = " ".join(_WORDS.get(w.lower(), w) for w in (words[:-1] if unit else words))
    if not text.startswith("σ"):  # a capital sigma would be a sum
        text = text[:1].upper() + text[1:]
    return f"{text}, {unit}" if unit else text


def show(value: object) -> str:
    """Write one value as a reader expects it: digits grouped, four significant figures, a dash for nothing."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f") if abs(value) >= 10_000 else str(value)
    if isinstance(value, float):
        if value == round(value) and abs(value) < 1e6:
            return show(round(value))
        return f"{value:.4g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(show(v) for v in value)
    return str(value)


def blocks(name: str, value: object) -> list[Block]:
    """Lay out any nesting of mappings, lists and scalars as tables.

    A mapping of mappings (or a list of them) with leaves in common becomes one table; other mappings become pairs,
    followed by one block for each mapping inside.
    """
    if isinstance(value, Sequence) and not isinstance(value, str):
        if value and all(isinstance(v, Mapping) for v in value):
            return [_grid(title(name), "", [("", _flat(v)) for v in value])]
        return [Block(title(name), (), tuple((show(v),) for v in value))] if value else []
    if not isinstance(value, Mapping):
        return [Block(title(name), (), ((show(value),),))]
    inner = {k: v for k, v in value.items() if isinstance(v, Mapping)}
    if len(inner) == len(value) and inner:
        flat = [(str(k), _flat(v)) for k, v in inner.items()]
        shared = set.intersection(*(set(f) for _, f in flat))
        if shared and len(shared) * 2 >= max(len(f) for _, f in flat):
            return [_grid(title(name), "", flat)]
    pairs = tuple((title(str(k)), show(v)) for k, v in value.items() if not _nested(v))
    out = [Block(title(name), (), pairs)] if pairs else []
    for key, part in value.items():
        if _nested(part):
            out += [b._replace(title=f"{title(name)} · {_lower(b.title)}") for b in blocks(str(key), part)]
    return out


def _nested(value: object) -> bool:
    if isinstance(value, Mapping):
        return True
    return isinstance(value, Sequence) and not isinstance(value, str) and any(isinstance(v, Mapping) for v in value)


def _lower(text: str) -> str:
    """Begin in lower case, abbreviations apart."""
    return text if text[:2].isupper() else text[:1].lower() + text[1:]


def _flat(value: Mapping[str, object], prefix: str = "") -> dict[str, str]:
    out: dict[str, str] = {}
    for key, part in value.items():
        name = f"{prefix} · {_lower(title(str(key)))}" if prefix else title(str(key))
        if isinstance(part, Mapping):
            out |= _flat(part, name)
        else:
            out[name] = show(part)
    return out


def _grid(name: str, corner: str, flat: Iterable[tuple[str, dict[str, str]]]) -> Block:
    rows = list(flat)
    columns = list(dict.fromkeys(c for _, f in rows for c in f))
    head = (corner,) if any(key for key, _ in rows) else ()
    body = tuple((((key,) if head else ()) + tuple(f.get(c, "–") for c in columns)) for key, f in rows)
    return Block(name, (*head, *columns), body)


def reason_rows(assignments: "pa.Table") -> list[tuple[str, int, float]]:
    """Count the reports by what became of them: (reason, number, share), largest first, used ones on top.

    Shares are of the reports in the time window of the run. Those outside come last and have none (NaN).
    """
    used = np.isfinite(numbers(assignments, "track_id"))
    if not len(used):
        return []
    unused = texts(assignments, "reason")[~used]
    names, counts = np.unique([r or "on no track" for r in unused], return_counts=True)
    rows = [("on a track", int(used.sum()))]
    rows += sorted(((str(n), int(c)) for n, c in zip(names, counts, strict=True)), key=lambda r: -r[1])
    rows.sort(key=lambda row: row[0] == OUTSIDE)
    judged = sum(n for name, n in rows if name != OUTSIDE)
    return [(name, n, np.nan if name == OUTSIDE or not judged else n / judged) for name, n in rows]


def innovation_rows(innovations: "pa.Table") -> list[InnovationRow]:
    """Compare each source's normalised innovation squared with what it is where the noise fits (`nis_interval`).

    Of updates by more or fewer components than two, NIS counts as 2 NIS / dof.

    Source: Bar-Shalom, Li and Kirubarajan (2001), section 5.4.2, in its normal approximation.
    """
    from scipy.special import gammainc

    source, nis, dof = texts(innovations, "source"), numbers(innovations, "nis"), numbers(innovations, "dof")
    known = np.isfinite(nis) & (dof > 0)
    out = []
    for name in dict.fromkeys(source[known].tolist()):
        pick = known & (source == name)
        n, mean = int(pick.sum()), 2.0 * float(np.mean(nis[pick] / dof[pick]))
        low, high = nis_interval(n)
        inside = float(np.mean(gammainc(dof[pick] / 2.0, nis[pick] / 2.0) <= 0.95))
        verdict = "noise used is too small" if mean > high else "noise used is too large" if mean < low else "fits"
        out.append(InnovationRow(name, n, mean, low, high, inside, verdict))
    return out
