"""Fields of the Comm-B registers that tell an aircraft's motion and intent.

Bit numbers count from 1 as in the tables; a value counts only when its status bit is set. Signed values are two's
complement, sign bit first. Source: ICAO Doc 9871, 2nd ed., tables A-2-64, A-2-80, A-2-96.
"""

from typing import NamedTuple

__all__ = ["REGISTERS", "RegisterField"]


class RegisterField(NamedTuple):
    """One field of a register of 56 bits."""

    name: str
    title: str
    status: int  # bit that says whether the value is given
    first: int
    last: int
    signed: bool
    lsb: float
    unit: str
    origin: float = 0.0  # what a raw value of 0 stands for


REGISTERS = {
    (4, 0): (  # selected vertical intention
        RegisterField("MCP_ALT", "MCP/FCU selected altitude", 1, 2, 13, False, 16.0, "ft"),
        RegisterField("FMS_ALT", "FMS selected altitude", 14, 15, 26, False, 16.0, "ft"),
        RegisterField("BARO", "barometric pressure setting", 27, 28, 39, False, 0.1, "mb", 800.0),
        RegisterField("VNAV", "VNAV mode engaged", 48, 49, 49, False, 1.0, ""),
        RegisterField("ALT_HOLD", "altitude hold mode engaged", 48, 50, 50, False, 1.0, ""),
        RegisterField("APPROACH", "approach mode engaged", 48, 51, 51, False, 1.0, ""),
        RegisterField("SOURCE", "source of the target altitude", 54, 55, 56, False, 1.0, ""),
    ),
    (5, 0): (  # track and turn
        RegisterField("ROLL", "roll angle, right wing down positive", 1, 2, 11, True, 45 / 256, "°"),
        RegisterField("TRACK", "true track angle", 12, 13, 23, True, 90 / 512, "°"),
        RegisterField("GS", "ground speed", 24, 25, 34, False, 2.0, "kt"),
        RegisterField("TRACK_RATE", "track angle rate", 35, 36, 45, True, 8 / 256, "°/s"),
        RegisterField("TAS", "true airspeed", 46, 47, 56, False, 2.0, "kt"),
    ),
    (6, 0): (  # heading and speed
        RegisterField("HEADING", "magnetic heading", 1, 2, 12, True, 90 / 512, "°"),
        RegisterField("IAS", "indicated airspeed", 13, 14, 23, False, 1.0, "kt"),
        RegisterField("MACH", "Mach number", 24, 25, 34, False, 2.048 / 512, "Mach"),
        RegisterField("BARO_RATE", "barometric altitude rate", 35, 36, 45, True, 32.0, "ft/min"),
        RegisterField("INERTIAL_RATE", "inertial vertical velocity", 46, 47, 56, True, 32.0, "ft/min"),
    ),
}
