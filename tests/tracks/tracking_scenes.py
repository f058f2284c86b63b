"""Measurements and runs for the tests of the tracker, made without its own placing of plots where that is judged."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from saltus.geo import Site
from saltus.records import Kind, Plots, Source, System
from saltus.tracks.measurements import Measurements, Noise, place_plots
from saltus.tracks.rows import assignments, join_fates, join_rows
from saltus.tracks.settings import FilterSettings, TrackerSettings
from saltus.tracks.sources import learn_setup
from saltus.tracks.tracker import Tracker

__all__ = ["SITE", "Tracked", "fed", "flights", "measured", "observed", "polar_noise", "run", "tracker_of"]

SITE = Site(float(np.radians(48.0)), float(np.radians(11.0)), 500.0)


class Tracked(NamedTuple):
    track_id: np.ndarray  # of each measurement, 0 = none or never confirmed
    rows: object  # saltus.tracks.tracker.Rows, of confirmed tracks
    raw: object  # Assignments
    all_rows: object


def measured(time, xy, sigma, *, altitude=None, sigma_altitude=10.0, source=0, icao24=-1, mode3a=-1):
    """Plane positions with equal independent errors, in time order; not polar."""
    time, xy = np.asarray(time, float), np.asarray(xy, float).reshape(-1, 2)
    n = len(time)
    order = np.argsort(time, kind="stable")

    def column(value, dtype):
        return np.broadcast_to(np.asarray(value, dtype), (n,))[order].copy()

    height = column(np.nan if altitude is None else altitude, float)
    cov = np.zeros((n, 3, 3))
    cov[:, 0, 0] = cov[:, 1, 1] = sigma**2
    cov[:, 2, 2] = np.where(np.isfinite(height), sigma_altitude**2, 1.0)
    return Measurements(
        plot=np.arange(n),
        time=time[order],
        source=column(source, np.int32),
        position=np.column_stack([xy[order], height]),
        cov=cov,
        icao24=column(icao24, np.int32),
        mode3a=column(mode3a, np.int16),
        callsign=np.full(n, "", "U8"),
        polar=np.full((n, 2), np.nan),
        elevation=np.full(n, np.nan),
        range_rate=np.full(n, np.nan),
        sigma_range_rate=np.ones(n),
        ray=np.full((n, 2), np.nan),
        lever=np.zeros((n, 2)),
        origin=np.full((n, 2), np.nan),
        bearing=np.full(n, np.nan),
        sigma_bearing=np.full(n, np.nan),
        jitter=np.zeros(n),
        lasting=np.zeros((n, 2, 2)),
        lasting_time=np.full(n, 60.0),
    )


def flights(start, velocity, times):
    """Positions (targets * times, 2) and times of straight flights, target by target."""
    start, velocity, times = (np.asarray(a, float) for a in (start, velocity, times))
    xy = start[:, None] + velocity[:, None] * times[:, None]
    return np.tile(times, len(start)), xy.reshape(-1, 2)


def observed(seen, radars, noise, plane, codes=None, height_prior=(5000.0, 3500.0)):
    """Simulated observations of several radars, placed as the program places them; labels in the same order."""
    sources = tuple(Source(System(48, 1, k + 1)) for k in range(len(radars)))
    label = np.concatenate([s.target for s in seen])
    columns = {
        "time": np.concatenate([s.time for s in seen]),
        "source": np.repeat(np.arange(len(seen)), [len(s.time) for s in seen]),
        "range": np.concatenate([s.slant for s in seen]),
        "azimuth": np.concatenate([s.azimuth for s in seen]),
        "altitude": np.concatenate([s.altitude for s in seen]),
    }
    n = len(label)
    columns |= {"file": np.zeros(n), "record": np.arange(n), "kind": np.full(n, Kind.POLAR)}
    if codes is not None:
        columns["icao24"] = np.append(codes, -1)[label]
    plots = Plots.build(n, sources, ("simulated",), columns)
    order = np.argsort(plots.time, kind="stable")
    m = place_plots(plots.take(order), plane, [r.site for r in radars], dict(enumerate(noise)), height_prior)
    return m, label[order]


def tracker_of(m, *, settings=None, filters=None, periods=(4.0,), identity=True, waits=None):
    settings, filters = settings or TrackerSettings(), filters or FilterSettings()
    setup = learn_setup(m, periods, waits, settings.clutter_density)
    return Tracker(settings, filters, setup, use_identity=identity)


def fed(tracker, m, chunk=None):
    """What a tracker says of measurements in pieces of `chunk`: rows, and what became of each measurement."""
    m = replace(m, plot=np.arange(len(m)))  # a scene put together of several may count anew in each
    parts, step = [], chunk or max(len(m), 1)
    for begin in range(0, len(m), step):
        piece = np.arange(begin, min(begin + step, len(m)))
        parts.append(tracker.feed(m.take(piece), until=np.inf if begin + step >= len(m) else -np.inf))
    rows, fates = join_rows([p.rows for p in parts]), join_fates([p.fates for p in parts])
    return rows, assignments(m.plot, fates, [p.confirmed for p in parts], tracker.conditions)


def run(m, **options):
    rows, raw = fed(tracker_of(m, **options), m)
    good = np.flatnonzero(np.isin(rows.track_id, raw.confirmed))
    picked = {f: getattr(rows, f)[good] for f in rows._fields if f != "moments"}
    sure = rows._replace(moments=type(rows.moments)(*(c[good] for c in rows.moments)), **picked)
    return Tracked(np.where(np.isin(raw.track_id, raw.confirmed), raw.track_id, 0), sure, raw, rows)


def polar_noise(radar):
    return Noise(range=radar.sigma_range, azimuth=radar.sigma_azimuth, altitude=max(radar.sigma_altitude, 1.0))
