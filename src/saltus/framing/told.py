"""What framing met on its way through a recording, counted and in words."""

from collections import Counter
from collections.abc import Mapping, Sequence

from saltus.framing.chunk import Chunk, Segment
from saltus.framing.containers import container
from saltus.framing.guess import Guess
from saltus.framing.network import Passed

__all__ = ["Told", "framing_words", "passed_words"]

_ONE_BY_ONE = 8  # problems of one kind told one by one
_PROTOCOLS = {1: "ICMP", 2: "IGMP", 6: "TCP", 17: "UDP", 47: "GRE", 50: "ESP", 58: "ICMPv6", 89: "OSPF", 103: "PIM"}
_PROTOCOLS |= {112: "VRRP", 132: "SCTP"}
_ETHERTYPES = {0x0806: "ARP", 0x8035: "RARP", 0x8100: "VLAN", 0x8809: "LACP", 0x88CC: "LLDP", 0x88F7: "PTP"}
_ETHERTYPES |= {0x8847: "MPLS", 0x8863: "PPPoE", 0x8864: "PPPoE", 0x9000: "loopback test"}
_LOST = {
    Passed.CUT: "packets were cut by the capture (snap length); the rest of each is lost",
    Passed.TORN: "UDP payloads end within a block; what follows their whole blocks is lost",
    Passed.MISSING: "parts of fragmented IP packets whose other parts are missing; not read",
}


class Told:
    """Framings, gaps and counts of one recording."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.segments: list[Segment] = []
        self.guesses: list[Guess] = []
        self.passed: dict[str, int] = {}  # packets and frames passed over, by protocol
        self.channels: list[str] = []
        self.n_blocks = 0
        self.n_gaps = self.n_gap_bytes = 0  # stretches without blocks
        self._problems: dict[str, list[str]] = {}
        self._more: Counter[str] = Counter()
        self._open: tuple[str, int] | None = None
        self._in_segment = self._lost = 0

    @property
    def problems(self) -> tuple[str, ...]:
        """What could not be read, with its byte."""
        told = [p for kind in self._problems.values() for p in kind]
        return (*told, *(f"{self.name}: {n} more {kind}." for kind, n in self._more.items()))

    def asked(self, name: str | None) -> None:
        """Note the framing that was asked for, and say so where another explains far more."""
        shares = {guess.name: guess.share for guess in self.guesses}
        best = self.guesses[0]
        if name is not None and best.share > 2 * shares.get(name, 0.0):
            self.tell(
                "framing",
                f"framing {name}, as asked, explains {shares.get(name, 0.0):.0%} of the first bytes, {best.name} "
                f"{best.share:.0%}; leave --framing out, or give --framing {best.name}.",
            )

    def begin(self, framing: str, at: int) -> None:
        """Note that a framing begins at a byte."""
        self._close(at)
        if self.segments:
            self.tell("changes of framing", f"byte {at}: the recording goes on as {framing_words(framing)}.")
        self._open = framing, at

    def count(self, chunk: Chunk) -> None:
        """Count the blocks of a chunk."""
        self.n_blocks += len(chunk)
        self._in_segment += len(chunk)

    def gap(self, start: int, stop: int, *, last: bool = False) -> None:
        """Note bytes without blocks."""
        self.n_gaps += 1
        self.n_gap_bytes += stop - start
        self._lost += stop - start
        size = stop - start
        missing = "whole packet" if self._open is not None and self._open[0].startswith("pcap") else "ASTERIX block"
        self.tell(
            "places without ASTERIX blocks",
            f"byte {start}: no {missing}, and none follows; the last {size} bytes are not used."
            if last
            else f"byte {start}: no ASTERIX block; skipped {size} bytes to the next one.",
        )

    def lie(self, at: int, category: int, said: int, true: int) -> None:
        """Note a block whose length is not that of its records."""
        self.tell(
            "blocks whose length lies",
            f"byte {at}: the block of category {category} says {said} bytes, the next begins after {true}: its whole "
            "records are used.",
        )

    def truncated(self, at: int, category: int, said: int, left: int) -> None:
        """Note a block that the recording's end cuts off."""
        self.tell(
            "truncated blocks",
            f"byte {at}: the block of category {category} says {said} bytes, {left} are left: truncated; its whole "
            "records are used.",
        )

    def foreign(self, n: int, at: int) -> None:
        """Note frames whose content is no ASTERIX."""
        self.passed["frames without ASTERIX"] = self.passed.get("frames without ASTERIX", 0) + n
        self.tell("frames without ASTERIX", f"byte {at}: {n} frames whose content is no ASTERIX.")

    def tell(self, kind: str, text: str) -> None:
        """Note a problem; of each kind the first are told one by one, the others counted."""
        told = self._problems.setdefault(kind, [])
        if len(told) < _ONE_BY_ONE:
            told.append(f"{self.name}: {text}")
        else:
            self._more[kind] += 1

    def end(self, at: int, passed: Mapping[tuple[int, int], tuple[int, int]], channels: Sequence[str]) -> None:
        """Close the account at the end of the recording."""
        self._close(at)
        self.channels = list(channels)
        counts: Counter[str] = Counter()
        for (kind, number), (n, first) in sorted(passed.items()):
            if kind in _LOST:
                where = f", the first at byte {first}" if first >= 0 else ""
                self.tell(str(kind), f"{n} {_LOST[Passed(kind)]}{where}.")
            else:
                counts[passed_words(kind, number)] += n
            if kind == Passed.PORT:
                foreign = sum(v[0] for (k, _), v in passed.items() if k == kind)
                begin = min(v[1] for (k, _), v in passed.items() if k == kind)
                self._problems["foreign"] = [
                    f"{self.name}: {foreign} UDP payloads are not ASTERIX, the first at byte {begin}."
                ]
        self.passed |= dict(counts.most_common())

    def _close(self, at: int) -> None:
        if self._open is not None:
            framing, start = self._open
            share = 1.0 - self._lost / max(at - start, 1)
            self.segments.append(Segment(framing, start, at, self._in_segment, share))
        self._open, self._in_segment, self._lost = None, 0, 0


def framing_words(name: str) -> str:
    """What a framing is called by people."""
    found = container(name)
    return found.words if found else {"pcap": "packet capture (pcap)", "pcapng": "packet capture (pcapng)"}[name]


def passed_words(kind: int, number: int) -> str:
    """What a packet passed over is."""
    if kind == Passed.LINK:
        return f"link type {number}, which is not read"
    if kind == Passed.ETHERTYPE:
        return _ETHERTYPES.get(number, f"Ethernet type 0x{number:04x}")
    if kind == Passed.LENGTH:
        return "IEEE 802.3 (spanning tree and others)"
    if kind == Passed.PROTOCOL:
        return _PROTOCOLS.get(number, f"IP protocol {number}")
    if kind == Passed.PORT:
        return f"UDP to port {number}, no ASTERIX"
    return "broken IP or UDP headers"
