"""Categories whose records are no target reports: services' own messages, and what is decoded and counted only.

    002  monoradar service messages (SPEC-0149-2a)   I002/000 message type: 1 north marker; 030 time of day
    019  multilateration status (SPEC-0149-18)       I019/000: 1 start of update cycle; 140 time of day
    023  ADS-B ground station (SPEC-0149-16)         I023/000 report type; 070 time of day
    034  monoradar service messages (SPEC-0149-2b)   I034/000 message type: 1 north marker; 030 time of day
    063  sensor status (SPEC-0149-10)                I063/030 time of message
    065  data processing system status (SPEC-0149-15) I065/000 message type; 030 time of message

The others are counted by type: safety nets (004), weather (008, 009), INCS (015), its configuration (016), Mode S
coordination (017, 018), ground station messages (025), miniplans (032), plans (150), direction finders (205), radar
video (240), version numbers (247); and combined systems' Mode S (007).
"""

from functools import partial

from saltus.io.columns import Category, status

__all__ = ["SERVICES"]


def _service(
    number: int, words: str, time: str, message: str, cycle: int = -1, site: tuple[str, str, str] | None = None
) -> Category:
    decode = partial(status, time=time, message=message, cycle=cycle, site=site)
    return Category(number, words, (time,) if time else (), (time, message, *(site or ())), decode)


def _counted(number: int, words: str, time: str, message: str = "") -> Category:
    return Category(
        number,
        words,
        (time,) if time else (),
        (time, message),
        partial(status, time=time, message=message),
        counted=True,
    )


SERVICES = (
    _service(2, "service messages of older radars", "030", "000", cycle=1),
    _service(19, "status of a multilateration system", "140", "000", cycle=1, site=("600/LAT", "600/LON", "610")),
    _service(34, "service messages of a radar", "030", "000", cycle=1, site=("120/LAT", "120/LON", "120/HGT")),
    _counted(23, "status of an ADS-B ground station", "070", "000"),
    _counted(63, "status of a centre's sensors", "030"),
    _counted(65, "status of a surveillance centre", "030", "000"),
    _counted(4, "safety net messages", "020", "000"),
    _counted(7, "combined Mode S reports", "140"),
    _counted(8, "weather seen by a radar", "090", "000"),
    _counted(9, "weather of several radars", "070", "000"),
    _counted(15, "reports of independent non-cooperative sensors", "145", "000/MT"),
    _counted(16, "configuration of independent non-cooperative sensors", "140", "000"),
    _counted(17, "coordination of Mode S radars", "140", "000"),
    _counted(18, "Mode S data link messages", "002", "000"),
    _counted(25, "status of ground systems", "070", "000/RTYP"),
    _counted(32, "flight plans in short", "020"),
    _counted(150, "flight plan messages", "", "080"),
    _counted(205, "bearings of radio direction finders", "030", "000"),
    _counted(240, "radar video", "140", "000"),
    _counted(247, "version numbers", "140"),
)
