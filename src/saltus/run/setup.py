"""`saltus setup`: what is learnt from the first stretch of recordings, as a configuration for others."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from saltus.config import load_config
from saltus.engine import SensorSetup, Session, Setup
from saltus.engine.learn import sigmas
from saltus.engine.saved import setup_toml
from saltus.errors import DataError
from saltus.io.inputs import left_out
from saltus.io.write import output_file, write_text
from saltus.progress import progress_bar
from saltus.run.follow import told_periods
from saltus.run.problems import refuse_unusable
from saltus.run.seen import Seen
from saltus.text import say, shown

__all__ = ["setup_files"]

_CHUNK = 1_000  # reports fed at a time, until there are enough


def setup_files(
    inputs: Sequence[Path],
    output: Path,
    config_path: Path | None = None,
    date: str | None = None,
    identity: str = "use",
    *,
    framing: str | None = None,
) -> Setup:
    """Learn a setup from the first stretch of recordings and write it as a file that `--config` reads.

    Args:
        inputs: recordings; several are merged by time.
        output: TOML file to write.
        config_path: TOML configuration; it goes before what is learnt, and into the file.
        date: YYYY-MM-DD of the recordings.
        identity: "use" or "ignore" the codes that plots carry.
        framing: of ASTERIX recordings.

    Raises:
        DataError: an input cannot be read, no report can be placed, or the output is one of the inputs.
        ModelError: the configuration is wrong.
    """
    if output.exists() and any(output.samefile(p) for p in (*inputs, config_path) if p is not None and p.exists()):
        raise DataError(f"{output}: would be overwritten, and is what the setup is made of. Give another -o.")
    with progress_bar() as bar, output_file(output) as path:
        config = load_config(config_path, date=date, framing=framing).model_copy(update={"learnt": None})
        session = Session.open(config, use_identity=identity == "use", hold=0.0, bar=bar, running=False)
        seen = Seen(config)
        for piece in config.read_in_order(inputs, bar.reading):
            seen.add(piece)
            session.tell_periods(told_periods(seen.contents))
            for start in range(0, 0 if session.learnt else len(piece.plots), _CHUNK):
                session.feed(piece.plots.take(slice(start, start + _CHUNK)))
            if session.learnt:
                break
        refuse_unusable(seen)
        setup = session.settle()
        write_text(path, setup_toml(setup, [shown(name) for name in piece.plots.files]))
    for problem in (*left_out(inputs), *seen.problems):
        say(f"note: {problem}")
    for sensor in setup.sensors:
        say(_line(sensor))
    undated = "" if config.date is None else f", with --date {config.date} for these recordings: it holds no date"
    say(f"written to {shown(str(output))}; saltus track reads it with --config{undated}")
    return setup


def _line(sensor: SensorSetup) -> str:
    """Say what was learnt of a sensor."""
    used = ", ".join(f"{label} {getattr(sensor.noise, field) * unit:.4g}" for label, field, unit in sigmas(sensor))
    said = "configured, told or learnt" if np.isfinite(sensor.told_period) else "assumed"
    return f"{sensor.name}: {used}; update period {sensor.period:.4g} s ({said})"
