"""Draw the one-way house: a floor for each layer of the import contract in pyproject.toml."""

import tomllib
from pathlib import Path

# What each module is, in a few words; groups of floors share a colour.
WORDS = {
    "cli": "the program: options in, one line out on failure",
    "demo": "two simulated radars, written, tracked and scored",
    "run": "recordings to tracks",
    "info": "what is in a recording",
    "convert": "every decoded item as a table",
    "score": "tracks against the truth",
    "injection": "faults put into recordings, and found again",
    "diagnose": "what noise a recording has",
    "gap": "how far a filter is from the optimum",
    "summary": "a run in numbers",
    "report": "one page of HTML",
    "engine": "sessions: setup, journal, checkpoints",
    "config": "the TOML configuration",
    "studies": "experiments that measure the filters",
    "montecarlo": "seeded runs, in order and reproducible",
    "evaluate": "one truth, one matching; RMSE, NEES, GOSPA, scores",
    "tracks": "gates, association, lifecycle, noise: many objects",
    "identify": "one object or two, at a stated error",
    "filters": "what we believe: the recursion, batch and bank",
    "decisions": "which mode to announce",
    "alarms": "when to raise one",
    "simulate": "trajectories, radars, draws of hybrid models",
    "models": "what the world is: chains, motion, sensors, priors",
    "io": "ASTERIX and tables to records",
    "framing": "containers and captures to data blocks",
    "asterix": "data blocks to columns and back",
    "records": "reports as arrays, SI units and radians",
    "geo": "the ellipsoid",
    "linalg": "small matrix algebra",
    "progress": "a bar",
    "times": "times as people write them",
    "text": "names fit to be read",
    "toml": "TOML files as tables",
    "compiled": "the compiled twins, where built",
    "errors": "ModelError, DataError, NumericalError",
    "shapes": "shapes of arrays in annotations",
    "streams": "standard streams and signals",
}
_COLOURS = (
    (("errors", "shapes", "streams", "geo", "records", "asterix", "framing", "io"), "#eef3ee", "#a9c2aa"),
    (("models", "simulate", "decisions", "filters", "identify", "tracks"), "#fbeeea", "#dba792"),
    (("evaluate", "montecarlo", "studies"), "#f3eef7", "#bfa9d1"),
    ((), "#e9f0f8", "#9db8d6"),
)
_LEFT, _WIDTH, _TOP, _FLOOR = 88, 300, 84, 34
_INK, _GREY = "#1c2430", "#44505e"


def layers() -> list[list[str]]:
    """Return the modules of each layer, the topmost first."""
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    (contract,) = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    return [[name.strip().removeprefix("saltus.") for name in layer.split("|")] for layer in contract["layers"]]


def draw() -> str:
    """Return the house as SVG in HTML."""
    floors = layers()
    ground, middle, arrow = _TOP + len(floors) * _FLOOR, _LEFT + _WIDTH / 2, _LEFT - 52
    parts = [
        f'<div class="drawing"><svg viewBox="0 0 800 {ground + 44}" role="img" aria-labelledby="house-title" '
        "font-family=\"system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif\">",
        '<title id="house-title">The one-way house: each module imports only from floors below</title>',
        '<defs><marker id="down" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0 L10 5 L0 10 z" fill="{_INK}"/></marker></defs>',
        f'<path d="M{_LEFT - 26} {_TOP} L{middle} 8 L{_LEFT + _WIDTH + 26} {_TOP} Z" fill="#1f4f86"/>',
        _text(middle, _TOP - 20, "saltus", size=17, fill="#fff", extra='font-weight="700"'),
        *(_floor(names, _TOP + k * _FLOOR) for k, names in enumerate(floors)),
        f'<rect x="{_LEFT - 26}" y="{ground}" width="{_WIDTH + 52}" height="12" fill="{_INK}"/>',
        _text(middle, ground + 34, "numpy, scipy, pyarrow, pyproj", size=12.5, fill=_GREY),
        f'<line x1="{arrow}" y1="{_TOP + 8}" x2="{arrow}" y2="{ground - 4}" stroke="{_INK}" stroke-width="1.6" '
        'marker-end="url(#down)"/>',
        f'<g transform="translate({arrow - 14} {(_TOP + ground) / 2}) rotate(-90)">',
        _text(0, 0, "imports go down, never up or sideways", size=13.5, fill=_INK) + "</g>",
        "</svg></div>",
    ]
    return "\n".join(parts)


def _floor(names: list[str], y: int) -> str:
    fill, edge = next((f, e) for members, f, e in _COLOURS if not members or (members and set(members) & set(names)))
    width = _WIDTH / len(names)
    said = "; ".join(WORDS.get(name, "") for name in names)
    parts = [f'<text x="{_LEFT + _WIDTH + 34}" y="{y + 22}" font-size="13.5" fill="{_GREY}">{said}</text>']
    for k, name in enumerate(names):
        x = _LEFT + k * width
        parts.append(f'<rect x="{x}" y="{y}" width="{width}" height="{_FLOOR}" fill="{fill}" stroke="{edge}"/>')
        mono = 'font-weight="600" font-family="ui-monospace, \'DejaVu Sans Mono\', monospace"'
        parts.append(_text(x + width / 2, y + 22, name, size=14, fill=_INK, extra=mono))
    return "\n".join(parts)


def _text(x: float, y: float, words: str, *, size: float, fill: str, extra: str = "") -> str:
    return f'<text x="{x}" y="{y}" text-anchor="middle" font-size="{size}" fill="{fill}" {extra}>{words}</text>'
