"""A session: reports are fed in pieces; what is known is told at once, and all of it after the end."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from saltus.config import Config, load_config
from saltus.engine.checkpoint import begin_anew, load_checkpoint, save_checkpoint, understood
from saltus.engine.identified import IDENTIFICATIONS
from saltus.engine.intake import Arrived, Intake, Leap
from saltus.engine.journal import Journal, foreign_columns
from saltus.engine.learn import first_setup, with_new_sources
from saltus.engine.live import Live
from saltus.engine.local import LocalTracking
from saltus.engine.news import News, Published
from saltus.engine.noted import local_ids, note_fed, placeable, renumbered
from saltus.engine.result import Result, finished, heard_so_far, order_of_systems
from saltus.engine.saved import saved_setup
from saltus.engine.setup import Setup
from saltus.engine.stored import config_from, setup_from, setup_state, source_from, source_words
from saltus.engine.stretch import Stretch
from saltus.engine.vetting import Vetting
from saltus.errors import DataError
from saltus.progress import Progress
from saltus.records import Plots, Source
from saltus.tracks.measurements import Measurements
from saltus.tracks.rows import Fed

__all__ = ["Published", "Session"]

_Index = npt.NDArray[np.int64]

_NOTED = ("time", "source", "file", "record", "local_id", "reason")  # of a report, in the journal


class Session:
    """Tracks reports as they come.

        session = Session.open("sensors.toml")
        published = session.feed(reports)
        session.save(folder)              # later: session = Session.restore(folder)
        result = session.finish()

    What becomes of a report depends on those before it, on the setup and on the times that reports tell, never on the
    pieces in which they come, nor on when a session was saved and restored.
    """

    _vetting: Vetting | None
    _live: Live | None  # of several systems

    def __init__(self, setup: Setup, *, hold: float | None = None, folder: Path | None = None) -> None:
        """Begin with a setup.

        Args:
            setup: of the sources.
            hold: s that a report may come late; 0: reports come in order of time; None: as configured.
            folder: of the journal; None: a temporary one.
        """
        self._begin(setup.config, setup.use_identity, {}, hold, folder, Progress())
        self._take_setup(setup)

    @classmethod
    def open(
        cls,
        config: Config | Path | str | None = None,
        *,
        use_identity: bool = True,
        periods: Mapping[str, float] | None = None,
        hold: float | None = None,
        folder: Path | None = None,
        bar: Progress | None = None,
        running: bool = True,
    ) -> "Session":
        """Begin without a setup: it is learnt from the first stretch of reports, which is then tracked under it.

        Args:
            config: what is known beforehand, or the TOML file that says it; one that `saltus setup` wrote holds a
                setup, and nothing is learnt.
            use_identity: whether addresses and codes count.
            periods: update period of each source that its reader tells, by designation, s.
            hold: s that a report may come late; 0: reports come in order of time; None: as configured.
            folder: of the journal; None: a temporary one.
            bar: shows progress.
            running: whether `feed` tells of several systems which tracks are one; `finish` does in any case.
        """
        session = cls.__new__(cls)
        known = config if isinstance(config, Config) else load_config(config)
        setup = saved_setup(known, use_identity=use_identity)
        known = known.model_copy(update={"learnt": None})
        session._begin(known, use_identity, periods or {}, hold, folder, bar or Progress())
        session._running = running
        if setup is not None:
            session._take_setup(setup)
        return session

    def _take_setup(self, setup: Setup) -> None:
        """Begin with a setup that was learnt before."""
        self._sources.extend(s.source for s in setup.sensors)
        self._vetting = Vetting()  # until it is found to fit the reports
        self._adopt(setup)

    def _begin(
        self,
        config: Config,
        use_identity: bool,
        periods: Mapping[str, float],
        hold: float | None,
        folder: Path | None,
        bar: Progress,
    ) -> None:
        self._config, self._use_identity = config, use_identity
        self._periods = dict(periods)
        self._bar, self._journal = bar, Journal(folder)
        self._sources: list[Source] = []
        self._files: list[str] = []
        self._n = 0
        self._hold = config.intake.hold if hold is None else hold
        self._intake, self._stretch = Intake(replace(config.intake, hold=self._hold)), Stretch(config.setup)
        self._setups: list[Setup] = []
        self._locals: dict[int, LocalTracking] = {}  # by the first source of each system
        self._news = News()
        self._running, self._live = True, None
        self.notes: dict[str, Any] = {}  # what the caller of `save` wanted to find again
        self._ended = False
        self._vetting = None

    @property
    def reports(self) -> int:
        """How many reports were fed."""
        return self._n

    @property
    def learnt(self) -> bool:
        """Whether there is a setup."""
        return bool(self._setups)

    @property
    def setup(self) -> Setup:
        """The setup that holds now.

        Raises:
            DataError: it is not learnt yet.
        """
        if not self._setups:
            raise DataError("the session has no setup yet: it is learnt from a first stretch of reports. Feed more.")
        return self._setups[-1]

    def feed(self, reports: Plots, tracks: pa.Table | None = None) -> Published:
        """Take reports in order of arrival; return what became known.

        Args:
            reports: any number; what cannot be used carries a reason.
            tracks: another centre's tracks up to now, with the columns of `Recording.tracks`.

        Raises:
            DataError: the session has ended, no report can be placed, or the setup is one of another place.
        """
        self._refuse_ended()
        if tracks is not None and len(tracks):
            self._journal.append("foreign", foreign_columns(tracks))
        plots, number = self._entered(reports)
        good = plots.reason == 0
        if self._vetting is not None and self._vetting.fits(self._setups[0], plots.take(good), last=False):
            self._vetting = None
        self._arrived(self._intake.add(plots.take(good), number[good]))
        return self._published()

    def tell_periods(self, periods: Mapping[str, float]) -> None:
        """Say the update periods, s, that readers tell of sources by now, by designation, for what is yet learnt."""
        self._periods |= periods

    def settle(self) -> Setup:
        """Return the setup, learnt from the reports so far if there was none: the first stretch ends.

        Raises:
            DataError: none of them is usable, or the session has ended.
        """
        self._refuse_ended()
        if not self._setups:
            self._learn()
        return self.setup

    def finish(self) -> Result:
        """End the session; return everything, known after the fact.

        Raises:
            DataError: nothing could be tracked.
        """
        self._refuse_ended()
        none = Plots.build(0, tuple(self._sources), tuple(self._files), {})
        if self._vetting is not None:
            self._vetting.fits(self._setups[0], none, last=True)
        self._arrived(self._intake.end(none))
        if not self._setups:
            self._learn()
        for own, tracking in self._locals.items():
            self._tell(own, tracking.end())
        self._ended, self._live, self._locals = True, None, {}
        setup = with_new_sources(self.setup, self._sources, self.setup.time, self._periods)  # lists the unusable, too
        result = finished(self._journal, setup, self._files, self.health())
        self._journal.close()
        return result

    def _refuse_ended(self) -> None:
        if self._ended:
            raise DataError("the session has ended; open another one.")

    def health(self) -> dict[str, Any]:
        """Return what is known of sources and reports."""
        return {
            "reports": self._n,
            "sources": [str(s.system) for s in self._sources],
            "setups": [s.time for s in self._setups],
            "clock_leaps": [leap._asdict() for leap in self._intake.leaps],
        }

    def _entered(self, reports: Plots) -> tuple[Plots, _Index]:
        """Number reports, their sources and files as the session does, and note them."""
        plots = placeable(renumbered(reports, self._sources, self._files), self._config)
        number = self._n + np.arange(len(plots))
        self._n += len(plots)
        self._journal.append("reports", {name: getattr(plots, name) for name in _NOTED})
        self._news.enter(plots, number)
        return plots, number

    def _arrived(self, arrived: Arrived) -> None:
        """Track what the intake lets go, or learn the setup from it first."""
        self._journal.append("refused", {"plot": arrived.refused, "reason": arrived.reason})
        self._news.refuse(arrived.refused, arrived.reason)
        plots, number = arrived.plots, arrived.number
        if not self._setups:
            stop = self._stretch.add(plots, number)
            if stop > len(plots):
                return
            self._learn()
            plots, number = plots.take(slice(stop, None)), number[stop:]
        self._track(plots, number)

    def _learn(self) -> None:
        """Learn the setup from the first stretch, and track that."""
        found = self._stretch.collected()
        if found is None:
            raise DataError("no report can be tracked: none of those fed is usable.")
        plots, number = found
        plots = self._of_sources(plots, int(plots.source.max()) + 1)
        self._adopt(first_setup(plots, self._config, self._periods, self._bar, use_identity=self._use_identity))
        self._stretch = Stretch(self._config.setup)
        self._track(plots, number)
        order = order_of_systems(self._journal, self._setups[-1], self._files)
        self._setups = [replace(setup, order=order) for setup in self._setups]
        self._look()

    def _of_sources(self, plots: Plots, count: int) -> Plots:
        """Reports of the first `count` sources: what comes later has no say in what is done before."""
        return replace(plots, sources=tuple(self._sources[:count]))

    def _adopt(self, setup: Setup) -> None:
        """Go on under a setup: systems and sources that were not there begin."""
        self._setups.append(setup)
        for party in setup.parties():
            if not any(setup.sensors[s].heard for s in party.sources):
                continue
            own = party.sources[0]
            if own in self._locals:
                self._tell(own, self._locals[own].adopt(setup, party))
            else:
                self._locals[own] = LocalTracking(setup, party)
        if self._live is not None:
            self._live.adopt(setup, list(self._locals))

    def _track(self, plots: Plots, number: _Index) -> None:
        """Track reports in order of time, under a new setup from where a new source appears."""
        while len(plots):
            setup = self.setup
            heard = np.array([s.heard for s in setup.sensors] + [False] * len(self._sources))
            new = np.flatnonzero(~heard[plots.source])
            stop = int(new[0]) if len(new) else len(plots)
            m = setup.placed(self._of_sources(plots.take(slice(0, stop)), len(setup.sensors)), number[:stop])
            self._journal.append("plots", m.columns())
            local_id = local_ids(plots, number[:stop], m)
            for own, tracking in self._locals.items():
                mine = tracking.own(m)
                self._tell(own, tracking.feed(m), m.take(mine), local_id[mine])
            self._look()
            plots, number = plots.take(slice(stop, None)), number[stop:]
            if len(plots):
                self._appeared(int(plots.source[0]), float(plots.time[0]))

    def _appeared(self, source: int, time: float) -> None:
        """Begin with a source that has not reported before."""
        setup = self.setup
        if source >= len(setup.sensors):
            setup = with_new_sources(setup, self._sources[: source + 1], time, self._periods)
        sensors = list(setup.sensors)
        sensors[source] = replace(sensors[source], heard=True, appeared=time)
        self._adopt(replace(setup, time=time, sensors=tuple(sensors)))

    def _look(self) -> None:
        """Look at several systems; the running picture of them begins when there are two."""
        if self._running and self._live is None and self.setup.order and len(self._locals) > 1:
            self._live = Live(self.setup, list(self._locals), heard_so_far(self._journal, self.setup))
        if self._live is not None:
            self._live.look()

    def _tell(self, own: int, fed: Fed, m: Measurements | None = None, local_id: _Index | None = None) -> None:
        """Note what a tracker knows anew, after it was given measurements."""
        if self._live is not None:
            self._live.take(own, self._live.heard(fed.rows, m, local_id))
        note_fed(self._journal, own, fed, self._locals[own].drained())
        self._news.tell(list(self._locals).index(own), fed)

    def _published(self) -> Published:
        kept = [tracking.referred() for tracking in self._locals.values()]
        live = self._live
        tables = self._news.taken(self._setups[-1] if self._setups else None, kept, live.named if live else None)
        return Published(*tables, live.taken() if live else IDENTIFICATIONS.empty_table(), self.health())

    def save(self, folder: Path | str, words: Mapping[str, Any] | None = None) -> None:
        """Save the session: `restore` goes on from here as if nothing had been.

        Args:
            folder: where; the journal moves there, and goes on there.
            words: what the caller wants to find again (`notes`), fit for JSON.

        Raises:
            DataError: the session has ended.
        """
        if self._ended:
            raise DataError("the session has ended: there is nothing to go on with.")
        folder = Path(folder)
        if not self._journal.lies_in(folder):
            begin_anew(folder)  # of another session
        self._journal.move(folder)
        setups = [setup_state(setup) for setup in self._setups]
        state = {
            "journal": self._journal.state(),
            "intake": self._intake.state(),
            "stretch": self._stretch.state(),
            "setup": {str(k): arrays for k, (arrays, _) in enumerate(setups)},
            "local": {str(own): tracking.state() for own, tracking in self._locals.items()},
            "news": self._news.state(),
            "vetting": {} if self._vetting is None else self._vetting.state(),
        }
        told = {
            "config": self._config.model_dump(mode="json"),
            "use_identity": self._use_identity,
            "periods": self._periods,
            "hold": self._hold,
            "sources": [source_words(s) for s in self._sources],
            "files": self._files,
            "reports": self._n,
            "setups": [words for _, words in setups],
            "running": self._running,
            "looked": None if self._live is None else self._live.looked,
            "leaps": [leap._asdict() for leap in self._intake.leaps],
            "notes": dict(words or {}),
        }
        save_checkpoint(folder, state, told)

    @classmethod
    def restore(cls, folder: Path | str, bar: Progress | None = None) -> "Session":
        """Go on with a session saved.

        Raises:
            DataError: there is none, or another version saved it.
        """
        folder = Path(folder)
        state, words = load_checkpoint(folder)
        session = cls.__new__(cls)
        with understood(folder):
            config = config_from(words["config"])
            session._begin(config, words["use_identity"], words["periods"], words["hold"], folder, bar or Progress())
            session.notes, session._running = words["notes"], words["running"]
            session._sources.extend(source_from(s) for s in words["sources"])
            session._files.extend(words["files"])
            session._n = int(words["reports"])
            for k, told in enumerate(words["setups"]):
                session._setups.append(setup_from(state["setup"].get(str(k), {}), told))
            like = Plots.build(0, tuple(session._sources), tuple(session._files), {})
            session._intake.restore(state["intake"], like)
            session._intake.leaps = [Leap(**leap) for leap in words["leaps"]]
            session._stretch.restore(state.get("stretch", {}), like)
            session._journal.restore(state.get("journal", {}))
            session._news.restore(state["news"])
            if "vetting" in state:
                session._vetting = Vetting(state["vetting"])
            for own, local in state.get("local", {}).items():
                party = next(p for p in session.setup.parties() if p.sources[0] == int(own))
                session._locals[int(own)] = LocalTracking(session.setup, party)
                session._locals[int(own)].restore(local)
            if words["looked"] is not None:
                heard = heard_so_far(session._journal, session.setup)
                session._live = Live(session.setup, list(session._locals), heard, words["looked"])
        return session
