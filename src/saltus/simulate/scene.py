"""The demonstration's scene: two radars 80 km apart, fourteen aircraft, ten minutes."""

from dataclasses import dataclass

import numpy as np

from saltus.geo import Plane, Site
from saltus.simulate.motion import Leg, Trajectory, coordinated_turn
from saltus.simulate.radar import Radar

__all__ = ["DURATION", "Aircraft", "RadarStation", "demo_aircraft", "demo_plane", "demo_radars"]

DURATION = 600.0  # s
FLIGHT_LEVEL = 30.48  # m
KNOT = 1852.0 / 3600.0  # m/s
_RATE_ONE = np.radians(3.0)  # rad/s, the standard turn


@dataclass(frozen=True, slots=True)
class Aircraft:
    """An aircraft: what it does, where it flies, what its transponder says."""

    name: str
    doing: str
    trajectory: Trajectory
    mode3a: int
    icao24: int = -1  # -1: Mode A/C only, and then no call sign


@dataclass(frozen=True, slots=True)
class RadarStation:
    """A radar with its ASTERIX name."""

    name: str
    sac: int
    sic: int
    radar: Radar


def demo_plane() -> Plane:
    """Return the plane in which the scene is flown, centred between the radars."""
    return Plane(*(float(np.radians(v)) for v in (48.175, 11.475)))


def demo_radars() -> tuple[RadarStation, RadarStation]:
    """Return the two radars, turning in 4 s and 5 s."""
    west = Site(float(np.radians(48.00)), float(np.radians(11.00)), 600.0)
    east = Site(float(np.radians(48.35)), float(np.radians(11.95)), 480.0)
    return (
        RadarStation("West", 25, 1, _secondary_radar(west, 4.0, 0.0)),
        RadarStation("East", 25, 2, _secondary_radar(east, 5.0, 1.7)),
    )


def _secondary_radar(site: Site, period: float, north_time: float) -> Radar:
    return Radar(
        site,
        period,
        sigma_range=25.0,
        sigma_azimuth=float(np.radians(0.05)),
        sigma_altitude=5.0,
        prob_detection=0.92,
        clutter_per_scan=10.0,
        north_time=north_time,
    )


def demo_aircraft() -> tuple[Aircraft, ...]:
    """Return the aircraft, half of them with Mode S."""
    return (*_airways(), *_manoeuvring(), *_low_and_slow())


def _airways() -> tuple[Aircraft, ...]:
    straight = (Leg(DURATION),)
    return (
        Aircraft("SAL101", "overflight", _through((0, 28), 370, 95, 480, straight), 0o1101, 0x3C0101),
        Aircraft("SAL102", "overflight", _through((22, 0), 350, 3, 455, straight), 0o1102, 0x3C0102),
        Aircraft("SAL103", "1000 ft over SAL104", _through((8, -40), 330, 60, 450, straight), 0o1103, 0x3C0103),
        Aircraft("SAL104", "1000 ft under SAL103", _through((8, -40), 320, 320, 430, straight), 0o1104),
        Aircraft("SAL105", "5 NM ahead of SAL106", _through((-25, 55), 310, 110, 440, straight), 0o1105),
        Aircraft("SAL106", "5 NM behind SAL105", _through((-33.7, 58.2), 310, 110, 440, straight), 0o1106),
        Aircraft("SAL107", "over the radar West", _through((-35.4, -17.5), 180, 40, 330, straight), 0o1107),
    )


def _manoeuvring() -> tuple[Aircraft, ...]:
    hold, fast, weave = 220 * KNOT, 480 * KNOT, 300 * KNOT
    racetrack = (Leg(60.0), Leg(60.0, turn_rate=_RATE_ONE)) * 5
    right, left = (coordinated_turn(_deg(a), 25.0, fast) for a in (150, -120))
    dash = (Leg(150.0), right, Leg(80.0, climb=40.0), Leg(60.0, climb=0.0), left, Leg(300.0))
    sway, back = (coordinated_turn(_deg(a), 4.5, weave) for a in (60, -60))
    wave = (Leg(60.0), sway, back, Leg(30.0), back, sway) * 3
    return (
        Aircraft(
            "SAL108", "holding pattern", Trajectory(_km(-12, 12, 100), _deg(270), hold, racetrack), 0o1110, 0x3C0108
        ),
        Aircraft(
            "SAL109", "2.5 g turns, a climb", Trajectory(_km(-70, -60, 150), _deg(45), fast, dash), 0o1111, 0x3C0109
        ),
        Aircraft("SAL110", "weaves, 25° of bank", Trajectory(_km(60, 45, 240), _deg(230), weave, wave), 0o1112),
        *_terminal(),
    )


def _terminal() -> tuple[Aircraft, ...]:
    departure = (
        Leg(40.0, climb=10.0),
        Leg(40.0, acceleration=1.0),
        Leg(30.0, turn_rate=-_RATE_ONE, climb=12.0),
        Leg(90.0, acceleration=0.6),
        Leg(180.0, climb=8.0),
        Leg(220.0, climb=0.0),
    )
    arrival = (
        Leg(60.0),
        Leg(180.0, climb=-10.0),
        Leg(80.0, acceleration=-0.7, climb=-8.0),
        Leg(20.0, turn_rate=_RATE_ONE),
        Leg(120.0, climb=-6.0),
        Leg(40.0, turn_rate=-_RATE_ONE, climb=0.0),
        Leg(100.0),
    )
    out = Trajectory(_km(20, -10, 30), _deg(80), 170 * KNOT, departure)
    home = Trajectory(_km(75, -45, 200), _deg(290), 350 * KNOT, arrival)
    return (
        Aircraft("SAL111", "departure", out, 0o1113, 0x3C0111),
        Aircraft("SAL112", "arrival", home, 0o1114, 0x3C0112),
    )


def _low_and_slow() -> tuple[Aircraft, ...]:
    circle = Leg(120.0, turn_rate=_RATE_ONE)
    return (
        Aircraft(
            "SAL113",
            "light, circles twice",
            Trajectory(_km(5, -22, 35), _deg(20), 105 * KNOT, (Leg(120.0), circle, Leg(90.0), circle, Leg(150.0))),
            0o7000,
        ),
        Aircraft(
            "SAL114",
            "light, turns back",
            Trajectory(
                _km(48, 30, 45), _deg(160), 120 * KNOT, (Leg(270.0), Leg(60.0, turn_rate=-_RATE_ONE), Leg(270.0))
            ),
            0o7000,
        ),
    )


def _through(
    place: tuple[float, float], level: float, course: float, knots: float, legs: tuple[Leg, ...]
) -> Trajectory:
    """Straight flight that is over a place (km) half way through the scene."""
    x, y, z = _km(*place, level)
    back = knots * KNOT * DURATION / 2
    return Trajectory(
        (x - back * np.sin(_deg(course)), y - back * np.cos(_deg(course)), z), _deg(course), knots * KNOT, legs
    )


def _km(x: float, y: float, level: float) -> tuple[float, float, float]:
    return 1e3 * x, 1e3 * y, level * FLIGHT_LEVEL


def _deg(angle: float) -> float:
    return float(np.radians(angle))
