"""CAT034, monoradar service messages: north markers and sector crossings (EUROCONTROL SPEC-0149-2b)."""

import numpy as np

from saltus.io.columns import Category, Columns, Decoded

__all__ = ["CAT034"]


def _decode(c: Columns) -> Decoded:
    kind = c.code("000")
    return Decoded(
        time_of_day=c.number("030"),
        is_report=np.zeros(c.n, np.bool_),
        types=kind,
        labels=c.layout.labels("000"),
        columns={},
        new_cycle=kind == 1,
        steps={},
    )


CAT034 = Category(34, ("010", "000", "030"), _decode)
