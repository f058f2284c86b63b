"""`saltus gap`: the comparison for a model file, as a table or JSON."""

import json
import math
from pathlib import Path

from saltus.gap.compare import optimality_gap
from saltus.gap.model_file import load_scenario
from saltus.io.write import output_file, write_text
from saltus.progress import progress_bar
from saltus.text import say

__all__ = ["show_gap"]


def show_gap(
    path: Path,
    *,
    runs: int,
    seed: int,
    fast: str,
    reference: str,
    particles: int,
    as_json: bool = False,
    output: Path | None = None,
) -> None:
    """Compare, print the table (or JSON), and write JSON to `output` if one is named.

    Raises:
        ModelError: the file is no model, or an option is out of range.
    """
    scenario = load_scenario(path)
    with progress_bar() as bar:
        gap = optimality_gap(
            scenario,
            runs=runs,
            seed=seed,
            fast=fast,
            reference=reference,
            particles=particles,
            progress=lambda done, every: bar.working("comparing", done / every),
        )
    text = json.dumps({"model": str(path), "seed": seed, **_clean(gap.to_dict())}, indent=2, allow_nan=False)
    if output is not None:
        with output_file(output) as temporary:
            write_text(temporary, text + "\n")
    say(text if as_json else "\n".join(gap.lines()))


def _clean(tree: dict[str, object]) -> dict[str, object]:
    """Null for what has no value: JSON knows no NaN."""

    def clean(value: object) -> object:
        if isinstance(value, dict):
            return {key: clean(v) for key, v in value.items()}
        if isinstance(value, list | tuple):
            return [clean(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {key: clean(value) for key, value in tree.items()}
