"""Sliders and jobs of the explorer.

Which keys have a slider, with which span, step and range. The newest job wins, at most one runs,
errors are reported."""

import contextlib
import math
import queue
import re
import threading

import pytest

from rootsopt.config import load, parse
from rootsopt.config.families import families
from rootsopt.config.sources import shipped
from rootsopt.view.pages.knobs import _step, dotted, knobs_of
from rootsopt.view.pages.session import Latest

FREE = "optimizer.bounds.helix_deg=[0, 90]", "rotor.helix_deg=20"


def by_key(config):
    return {knob.key: knob for knob in knobs_of(config)}


@pytest.mark.parametrize(
    ("name", "changes"), [*((name, ()) for name in shipped()), ("cic_drawn", FREE), ("free", FREE)]
)
def test_every_knob_can_be_set(name, changes):
    """A knob's own value lies in its span, the span in its range, and the config accepts it."""
    config = load(name, changes)
    knobs = knobs_of(config)
    assert len({knob.key for knob in knobs}) == len(knobs)
    for knob in knobs:
        assert knob.least <= knob.low <= knob.value <= knob.high <= knob.most
        assert knob.step > 0
        assert knob.group == knob.group.strip() != ""
    values = {knob.key: int(knob.value) if knob.whole else knob.value for knob in knobs}
    assert config.replaced(values) == config.replaced({})
    config.check_values({knob.key: knob.low for knob in knobs if not knob.whole})


@pytest.mark.parametrize("changes", [(), FREE])
@pytest.mark.parametrize("family", [name for name, one in families().items() if one.maker])
def test_every_family_has_a_knob_per_design_parameter(family, changes):
    """Design parameters come first, and span the bounds of an optimisation.

    A twist that is free is one of them, in the section of the rotor."""
    rows = "".join(f"\n  {key}: {list(x) if isinstance(x, tuple) else x}"
                   for key, x in families()[family].example.items())  # fmt: skip
    text = shipped()["ee"].read_text().replace("family: ee", f"family: {family}")
    config = parse(text.replace("  lobes: 3", f"  lobes: 3{rows}"), changes)
    knobs = knobs_of(config)
    design = [knob for knob in knobs if knob.group == "Design"]
    assert [(knob.key, knob.value) for knob in design] == [
        (dotted(key), value) for key, value in zip(config.design_keys, config.design, strict=True)
    ]
    assert [(knob.key, knob.low, knob.high) for knob in design if "profile." not in knob.key] == [
        ("rotor.helix_deg", 0, 90)
    ] * bool(changes)
    assert knobs[: len(design)] == design
    assert all(math.isfinite(knob.low) and math.isfinite(knob.high) for knob in design)


def test_only_parts_of_the_scene_have_knobs():
    """So has the smoothing, only if it is given."""
    cic, pump = by_key(load("cic_drawn")), by_key(load("pump"))
    bare = by_key(load("cic_drawn", ["scene.timing_gear=null", "contact.smoothing_mm=1e-4"]))
    assert "scene.timing_gear.backlash_mm" in cic
    assert not re.findall("motor|friction|smoothing", " ".join(cic))
    assert {"scene.motor.slope_N_m_s_per_rad", "contact.friction.static"} <= pump.keys()
    assert "scene.load.torque_N_m" not in pump
    assert "contact.smoothing_mm" in bare
    assert not re.findall("timing_gear", " ".join(bare))


def test_spans_units_and_texts():
    knobs = by_key(load("cic_drawn"))
    speed, angle = knobs["scene.speed_rpm"], knobs["profile.pressure_angle_deg"]
    assert (speed.low, speed.high, speed.step, speed.unit) == (600, 6000, 20, "rpm")
    assert (speed.least, speed.most) == (1e-2, 1e6)
    assert "speed of rotor 1" in speed.help
    assert (angle.low, angle.high, angle.unit, angle.name) == (25, 45, "°", "pressure angle")
    clearance, helix = knobs["contact.clearance_mm"], knobs["rotor.helix_deg"]
    assert clearance.low == clearance.value == 0 < clearance.high
    assert helix.low == -helix.high
    assert knobs["profile.lobes"].whole
    far = by_key(load("cic_drawn", ["profile.tip_arc_angle_deg=12"]))
    assert far["profile.tip_arc_angle_deg"].high == 12  # beyond its bounds
    long = ["profile.pitch_radius_mm=5000", "profile.involute_length_mm=6000"]
    unbounded = by_key(load("cic_drawn", long))["profile.involute_length_mm"]
    assert unbounded.high == unbounded.most == 10_000


@pytest.mark.parametrize("width", [1e-4, 0.3, 1.0, 4.0, 20.0, 5400.0, 1e6])
def test_steps_are_round_and_many(width):
    step = _step(width)
    assert 200 <= width / step * (1 + 1e-9) < 500
    lead = step / 10 ** math.floor(math.log10(step) + 1e-9)
    assert lead == pytest.approx(round(lead))


@pytest.fixture
def errors():
    return queue.SimpleQueue()


@pytest.fixture
def lane(errors):
    with contextlib.closing(Latest(errors.put)) as made:
        yield made


def test_newest_job_replaces_those_that_wait(lane):
    """While the first job runs, a hundred others arrive: only the last of them runs.

    A job that is not due yet is replaced at once, too, or dropped."""
    begun, go, end = (threading.Event() for _ in range(3))
    ran = []
    lane.submit(lambda: (begun.set(), go.wait(20), ran.append(-1)))
    assert begun.wait(20)
    for k in range(100):
        lane.submit(lambda k=k: (ran.append(k), k == 99 and end.set()))
    assert lane.seconds > 0
    go.set()
    assert end.wait(20)
    end.clear()
    lane.submit(lambda: ran.append("late"), delay=60)
    lane.submit(lambda: ran.append("dropped"), delay=0.05)
    lane.clear()
    lane.submit(end.set, delay=0.1)
    assert end.wait(20)
    assert ran == [-1, 99]


def test_error_is_reported_and_the_next_job_runs(lane, errors):
    end = threading.Event()
    lane.submit(lambda: 1 / 0)
    assert isinstance(errors.get(timeout=20), ZeroDivisionError)
    lane.submit(end.set)
    assert end.wait(20)
