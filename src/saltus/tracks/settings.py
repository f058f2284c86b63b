"""What a user may set of the tracker; every field is a key of the configuration's [tracker] or [filter] table."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from saltus.errors import ModelError

__all__ = ["FilterSettings", "RegistrationSettings", "SystemsSettings", "TrackerSettings", "positive"]

_FASTEST_TURN = 45.0  # degrees/s: faster, a turn is a circle between two plots


def positive(table: str, settings: object, *names: str) -> None:
    """Refuse fields of a table that are not positive and finite.

    Raises:
        ModelError: one is not; the message names it.
    """
    for name in names:
        value = getattr(settings, name)
        if not 0.0 < value < np.inf:
            raise ModelError(f"{table}.{name} must be positive and finite, got {value}.")


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """The multimode filters of every track.

    Horizontal modes are steady motion, turns to the left and right at given rates, and levels of acceleration; each
    is left after its mean stay. A mode's acceleration is white noise of density accel^2 accel_time, the same for a
    target whatever sees it, how often, and from how many places.

    Attributes:
        form: "decomposed" runs a horizontal and a vertical filter side by side; "joint" one filter in three
            dimensions with the product of the modes and the full covariance of each plot, which matters at short
            range and high elevation.
        accel_h: acceleration of each horizontal mode that does not turn, m/s^2, steady first.
        sojourn_h: mean stay in each of them, s.
        turn_rate: rates of turn, degrees/s; each is two modes, left and right. Of the hardest acceleration of
            `accel_h`, three tenths come on top of a turn. () = no such modes, nor
            beside a single level of acceleration.
        turn_sojourn: mean stay in each turn, s.
        accel_v: acceleration of each vertical mode, m/s^2.
        sojourn_v: mean stay in each vertical mode, s.
        accel_time: s that an acceleration lasts, whatever the intervals between plots. 0 = from plot to plot: it is
            constant between two and independent in the next interval, so a track seen more often is taken for one
            that turns less.
    """

    form: Literal["decomposed", "joint"] = "decomposed"
    accel_h: tuple[float, ...] = (0.15, 3.0)
    sojourn_h: tuple[float, ...] = (150.0, 10.0)
    turn_rate: tuple[float, ...] = (1.5,)
    turn_sojourn: float = 15.0
    accel_v: tuple[float, ...] = (0.1, 2.5)
    sojourn_v: tuple[float, ...] = (90.0, 15.0)
    accel_time: float = 4.0

    @property
    def steady_density(self) -> float:
        """Density of the horizontal acceleration in steady motion, m^2/s^3; one from plot to plot lasts a second."""
        return self.accel_h[0] ** 2 * (self.accel_time or 1.0)

    def __post_init__(self) -> None:
        """Refuse settings that describe no filter."""
        if self.form not in ("decomposed", "joint"):
            raise ModelError(f'filter.form is "decomposed" or "joint", not {self.form!r}.')
        if not 0.0 <= self.accel_time < np.inf:
            raise ModelError(f"filter.accel_time is 0 or a time in s, got {self.accel_time}.")
        for axis in "hv":
            accel, sojourn = getattr(self, f"accel_{axis}"), getattr(self, f"sojourn_{axis}")
            if len(accel) != len(sojourn) or not accel:
                raise ModelError(
                    f"filter.accel_{axis} has {len(accel)} modes and filter.sojourn_{axis} has {len(sojourn)}; "
                    "give one acceleration and one mean stay per mode."
                )
            if min(accel) <= 0 or min(sojourn) <= 0 or not np.all(np.isfinite(accel + sojourn)):
                raise ModelError(f"filter.accel_{axis} and filter.sojourn_{axis} must be positive: m/s^2 and s.")
            if list(accel) != sorted(accel):
                raise ModelError(f"filter.accel_{axis} must ascend, steady motion first; got {accel}.")
        if any(not 0.0 < rate <= _FASTEST_TURN for rate in self.turn_rate):
            raise ModelError(
                f"filter.turn_rate holds rates of turn to either side, above 0 and up to {_FASTEST_TURN:g} degrees/s; "
                f"got {self.turn_rate}."
            )
        if not 0.0 < self.turn_sojourn < np.inf:
            raise ModelError(f"filter.turn_sojourn is a time in s, got {self.turn_sojourn}.")


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Association, initiation and deletion.

    Attributes:
        gate_probability: probability that a target's own plot falls inside its gate.
        most_candidates: plots of a slice that one track chooses among: those nearest, in standard deviations, where its
            gate holds more; reports of its own address are always among them.
        detection_probability: probability that a target gives a plot in a scan.
        clutter_density: false plots and new targets per m^2 and scan; a higher value makes the tracker prefer
            leaving a distant plot alone to stretching a track. Absent: a tenth of the density of the source's plots
            over all it covers, and a twentieth of that of the other plots around.
        clutter_density_azimuth: false bearings and other objects per radian and scan, of sources that give bearings
            alone.
        max_speed: fastest target, m/s: no track starts faster, and one that becomes so is dropped.
        confirm_hits, confirm_scans: a track is confirmed when it got `confirm_hits` plots in the last
            `confirm_scans` expected ones (M of N).
        coast_scans: a confirmed track is dropped after so many expected plots missed in a row, but not before
            `coast_seconds`.
        coast_seconds: shortest time a confirmed track coasts before it is dropped, s.
        split_range: a plot left over within this range (m) and `split_azimuth` (degrees) of a plot of the same
            source and scan that updated a confirmed track, with no other height or identity, is a split plot. The
            range is 75 m, 15 standard deviations of the plot and the way flown in between, if that is less.
        split_azimuth: see split_range.
        altitude_outlier: probability that a plot's height is wrong (garbled Mode C); such a height is ignored.
        range_rate_outlier: probability that a plot's range rate is wrong (folded by ambiguity); such a rate is ignored.
        plot_outlier: probability that a radar plot's azimuth is faulty, and its range, or the position of another
            sensor, each plot by itself; 0 = none is. A plot outside the gate of a confirmed track, or of one of its
            own address, may still be taken for such a fault, with the deviations below.
        outlier_azimuth: standard deviation of a faulty azimuth, degrees.
        outlier_range: standard deviation of a faulty range, m, but no more than a tenth of the range.
        outlier_xy: standard deviation of a faulty position, each axis, m.
        degraded_noise: factor of the standard deviations of a degraded source: of azimuth or range or both, or of
            position; 1 = no source degrades.
        degraded_sojourn: mean time that a source is well, and degraded, s.
        lasting_states: states beside position and velocity that a track has for errors that last, two for a source of
            positions, one for a radar; where they do not suffice, such errors are taken for noise.
        lasting_silence: correlation times that a source must have been silent before its states are another's.
        height_prior: mean and standard deviation of the height of targets that do not tell it, m; what a surface
            movement sensor (CAT010) sees is taken to stand on the ground.
        sigma_pressure: error of pressure altitude as geometric height, m; widens the published covariance near
            the radar, where height bends slant range.
    """

    gate_probability: float = 0.9999
    most_candidates: int = 12
    detection_probability: float = 0.95
    clutter_density: float | None = None
    clutter_density_azimuth: float = 1.0
    max_speed: float = 400.0
    confirm_hits: int = 3
    confirm_scans: int = 5
    coast_scans: int = 5
    coast_seconds: float = 20.0
    split_range: float = 300.0
    split_azimuth: float = 3.0
    altitude_outlier: float = 1e-3
    range_rate_outlier: float = 1e-2
    plot_outlier: float = 1e-3
    outlier_azimuth: float = 1.5
    outlier_range: float = 400.0
    outlier_xy: float = 200.0
    degraded_noise: float = 5.0
    degraded_sojourn: tuple[float, float] = (7200.0, 60.0)
    lasting_states: int = 4
    lasting_silence: float = 5.0
    height_prior: tuple[float, float] = (5000.0, 3500.0)
    sigma_pressure: float = 100.0

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        for name in ("gate_probability", "detection_probability", "altitude_outlier", "range_rate_outlier"):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise ModelError(f"tracker.{name} is a probability between 0 and 1, got {value}.")
        if not 0.0 <= self.plot_outlier < 0.5:
            raise ModelError(f"tracker.plot_outlier is a probability below 0.5, 0 for no faults: {self.plot_outlier}.")
        if not 1.0 <= self.degraded_noise < np.inf:
            raise ModelError(f"tracker.degraded_noise is a factor, 1 or greater: {self.degraded_noise}.")
        if not 1 <= self.confirm_hits <= self.confirm_scans <= 32:
            raise ModelError(
                f"tracker.confirm_hits of confirm_scans (M of N) needs 1 <= M <= N <= 32, "
                f"got {self.confirm_hits} of {self.confirm_scans}."
            )
        if self.lasting_states < 0:
            raise ModelError(f"tracker.lasting_states is a number of states, 0 for none, got {self.lasting_states}.")
        if self.most_candidates < 1:
            raise ModelError(f"tracker.most_candidates is a number of plots, 1 or more, got {self.most_candidates}.")
        positive("tracker", self, "clutter_density_azimuth", "max_speed", "coast_scans", "coast_seconds", "split_range")
        positive("tracker", self, "split_azimuth", "outlier_azimuth", "outlier_range", "outlier_xy", "sigma_pressure")
        positive("tracker", self, "lasting_silence")
        given = {"height_prior[1]": self.height_prior[1]}
        given |= {f"degraded_sojourn[{k}]": stay for k, stay in enumerate(self.degraded_sojourn)}
        if not np.isfinite(self.height_prior[0]):
            raise ModelError(f"tracker.height_prior[0] is a height in m, got {self.height_prior[0]}.")
        if self.clutter_density is not None:
            given["clutter_density"] = self.clutter_density
        for name, value in given.items():
            if not 0.0 < value < np.inf:
                raise ModelError(f"tracker.{name} must be positive and finite, got {value}.")


@dataclass(frozen=True, slots=True)
class SystemsSettings:
    """When tracks of two systems become one.

    Attributes:
        reference: name of the system whose positions hold; "" = that with the smallest stated noise, radars last.
        p_false: largest probability of being two objects with which two tracks are declared one.
        p_false_split: the same for two tracks of one radar, second echoes of an object in motion.
        split_offset: standard deviation of the distance between two echoes of one object, each axis, m.
        hysteresis: log-odds by which a declared pair may fall short of the best alternative, nats.
        every: s between two looks at what the systems say, at which tracks are declared one.
        window: s; what tracks did longer ago says nothing about whether they are one object now.
        offset_time: s that the difference between two systems' positions of one object lasts.
        spacing: s that short errors last: of reports of one track that follow faster, one in so many s counts.
        speed: standard deviation of each component of an object's velocity, m/s.
        track_sigma: standard deviation of positions in another centre's tracks (CAT062), each axis, m.
        track_memory: time constant of that centre's filter, s.
        silent: s without a report after which a local track counts as ended, until it reports again.
        rows_kept: s of reports, beyond `registration.interval`, that a look may still need.
        rivals: tracks at a time, at least, of which a partner could be any.
        lately: s within which another system must have seen a target for its frame to hold.
        step: standard deviations of a report by which a correction steps, from which a state is moved with it.
        evidence: ratios of pairs at looks that are kept for the report; of more, those of every second look, fourth ...
    """

    reference: str = ""
    p_false: float = 1e-3
    p_false_split: float = 1e-3
    split_offset: float = 20.0
    hysteresis: float = 5.0
    every: float = 10.0
    window: float = 120.0
    offset_time: float = 60.0
    spacing: float = 10.0
    speed: float = 100.0
    track_sigma: float = 50.0
    track_memory: float = 10.0
    silent: float = 60.0
    rows_kept: float = 90.0
    rivals: float = 2.0
    lately: float = 30.0
    step: float = 2.0
    evidence: int = 500_000

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        for name in ("p_false", "p_false_split"):
            if not 0.0 < getattr(self, name) < 0.5:
                raise ModelError(f"systems.{name} is a probability below 0.5, got {getattr(self, name)}.")
        names = tuple(name for name in self.__slots__ if name not in ("reference", "p_false", "p_false_split"))
        positive("systems", self, *names)


@dataclass(frozen=True, slots=True)
class RegistrationSettings:
    """What biases to expect between systems, and how fast they may change.

    Attributes:
        sigma_offset: standard deviation of a position offset, each axis, m, before anything is known.
        sigma_azimuth: of an azimuth bias, degrees.
        sigma_range: of a range bias, m.
        sigma_range_scale: of a range scale error, as a share of range.
        sigma_time: of a time stamp bias, s.
        scatter: expected standard deviation of the offset between objects (antenna, reflector), each axis, m; the
            data correct it.
        block: s that errors of reports last: so long a stretch of a track counts as one residual.
        interval: s between two estimates.
        memory: s after which residuals are forgotten.
        widening: factor of a standard deviation that telling parameters apart may cost; what costs more is not
            separable by the geometry and not estimated.
    """

    sigma_offset: float = 50.0
    sigma_azimuth: float = 1.0
    sigma_range: float = 50.0
    sigma_range_scale: float = 2e-4
    sigma_time: float = 0.5
    scatter: float = 5.0
    block: float = 10.0
    interval: float = 30.0
    memory: float = 3600.0
    widening: float = 1.3

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        positive("registration", self, *self.__slots__)

    @property
    def prior(self) -> npt.NDArray[np.float64]:
        """Standard deviations in the order and units of `saltus.tracks.bias.PARAMETERS`."""
        azimuth = float(np.radians(self.sigma_azimuth))
        offset = self.sigma_offset
        return np.array([offset, offset, azimuth, self.sigma_range, self.sigma_range_scale, self.sigma_time])
