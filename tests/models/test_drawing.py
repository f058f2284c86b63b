"""What a drawing says, against the description it was made from."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from saltus import Chain, Gaussian, HybridModel, LinearSDE, LinearSensor, PositionSensor, constant_velocity
from saltus.models import OK, Condition, FaultySensor, PolarSensor, diagram
from saltus.models.drawing import dependences

SVG = "{http://www.w3.org/2000/svg}"
TURN = Chain("turn", {"no": 1.0, "yes": 5.0}, stay=0.9)
JAM = Chain("jam", {"ok": OK, "jammed": Condition(noise=10.0)}, stay=0.9)
DRIFT = Chain("drift <x>", {"ok": OK, "off": Condition(bias=0.1)}, stay=0.9)
PRIOR = Gaussian([100.0, 1.0, 200.0, 0.0], np.eye(4))


def model(*chains, accel=1.0, **sensors):
    return HybridModel(chains, constant_velocity(2, accel=accel), sensors, PRIOR)


@pytest.fixture
def shared():
    polar = PolarSensor(sigma_range=10.0, sigma_azimuth=lambda turn: 0.01 * turn)
    return model(
        TURN,
        JAM,
        DRIFT,
        accel=lambda turn: turn,
        radar=FaultySensor(polar, {"jam": None, "drift <x>": [1]}),
        link=FaultySensor(PositionSensor(2, 5.0), ["jam"]),
        plain=LinearSensor(H=[[1.0, 0.0, 0.0, 0.0]], R=[[1.0]]),
    )


def texts(svg):
    return ["".join(node.itertext()) for node in ET.fromstring(svg).iter(f"{SVG}text")]


def test_dependences_are_those_described(shared):
    assert [tuple(d) for d in dependences(shared)] == [
        ("motion", "4 states", ("turn",)),
        ("radar", "2 components", ("turn", "jam", "drift <x>")),
        ("link", "2 components", ("jam",)),
        ("plain", "1 component", ()),
    ]


def test_a_known_input_that_depends_on_a_chain():
    pushed = LinearSDE([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], drift=lambda turn: [0.0, turn])
    sensors = {"s": PositionSensor(1, 1.0)}
    one = HybridModel([JAM, TURN], pushed, sensors, Gaussian([0.0, 0.0], np.eye(2)))
    assert dependences(one)[0].chains == ("turn",)


def test_drawing_shows_every_name_and_one_link_per_dependence(shared):
    svg = diagram(shared)
    words = texts(svg)
    for name in ("turn", "jam", "drift <x>", "motion", "radar", "link", "plain", "ok, jammed", "no, yes"):
        assert name in words, name
    assert "predict in 8 channels" in words and "2 × 2 × 2: one per joint mode" in words
    links = [path for path in ET.fromstring(svg).iter(f"{SVG}path") if path.get("class") == "link"]
    assert len(links) == sum(len(d.chains) for d in dependences(shared))


def test_a_kalman_filter_has_one_channel_and_no_links():
    svg = diagram(model(radar=PositionSensor(2, 1.0)))
    assert "predict in 1 channel" in texts(svg) and 'class="link"' not in svg


def test_boxes_lie_inside_and_apart(shared):
    root = ET.fromstring(diagram(shared))
    width, height = float(root.get("width")), float(root.get("height"))
    boxes = [
        tuple(float(r.get(k)) for k in ("x", "y", "width", "height")) for r in root.iter(f"{SVG}rect") if r.get("x")
    ]
    assert len(boxes) == 3 + 4 + 5
    for i, (x, y, w, h) in enumerate(boxes):
        assert x >= 0 and y >= 0 and x + w <= width and y + h <= height
        for x2, y2, w2, h2 in boxes[:i]:
            assert x + w <= x2 or x2 + w2 <= x or y + h <= y2 or y2 + h2 <= y


def test_long_names_are_cut():
    long = Chain("a_name_that_goes_on_and_on_and_on_and_on", ["one", "two"], stay=0.9)
    words = texts(diagram(model(long, radar=PositionSensor(2, 1.0))))
    assert any(w.startswith("a_name_that_goes") and w.endswith("…") for w in words)


def test_the_picture_of_the_documentation_is_the_one_its_page_draws(tmp_path, monkeypatch):
    docs = Path(__file__).parents[2] / "docs"
    page = (docs / "decisions.md").read_text(encoding="utf-8")
    first, *_, last = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    described = first[: first.index("arrays =")]
    monkeypatch.chdir(tmp_path)
    exec(compile(described + last, "decisions.md", "exec"), {})
    assert (tmp_path / "model.svg").read_text("utf-8") == (docs / "images/model.svg").read_text("utf-8")
