"""What the summary doubts: noise that innovations contradict either way, and figures that cannot both be."""

import pytest

from saltus.summary import _doubts


def row(nis, configured, estimated, updates=500):
    return {
        "nis_mean": nis,
        "nis_updates": updates,
        "sigma_range_m": {"configured": configured, "estimated": estimated, "used": configured},
    }


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (row(2.0, 30.0, 28.0), []),
        (row(None, None, None), []),
        (row(1.0, None, 28.0), []),
        (row(4.0, 30.0, 28.0, updates=9), []),
        (row(0.1, 30.0, 28.0, updates=9), []),
        (row(4.0, 30.0, 28.0), ["larger than the noise used"]),
        (row(0.1, 30.0, None), ["far smaller than the noise used"]),
        (row(2.0, 0.05, 4.6), ["configured as 0.05 and its tracks say 4.6"]),
        (row(1e-4, 5.0, 0.0021), ["far smaller", "configured as 5.0 and its tracks say 0.0021"]),
    ],
)
def test_doubts(given, words):
    lines = _doubts({"radar": given}, several=False)
    assert len(lines) == len(words)
    for line, said in zip(lines, words, strict=True):
        assert line.startswith("radar: ") and said in line
