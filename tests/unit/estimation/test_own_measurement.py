"""Measurements of installed packages: fused as all others; what a package gets wrong costs only its own samples."""

from __future__ import annotations

import math
import re
import runpy
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support_cart import rig, some_nav
from support_filter import QUICK_IMU, RIG, simulation
from support_journal import OPEN, JournalRig

from modelserver.errors import ConfigError, RecordingError
from modelserver.estimation.filter.eskf import ErrorState
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.measurements import MEASUREMENT_TYPES, Innovation, MeasurementContext
from modelserver.estimation.filter.measurements.measurement import OwnMeasurement, get_type, read_covariance
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Setup
from modelserver.messages import Decision, ImuSample, MeasurementSample, Mode, SensorHeader, SwitchMode, Verdict
from modelserver.server.journal import encoding as journal_state
from modelserver.server.journal.encoding import RunState
from modelserver.simulation import figure_eight

EXAMPLE = runpy.run_path(str(Path(__file__).resolve().parents[3] / "examples" / "python" / "own_measurement.py"))
RADAR: Any = EXAMPLE["RADAR"]
AIDING = "\n  aiding: {front: {channel: RADAR, type: radar}}\n"
HEADER = SensorHeader(1_700_000_000_000_000, "radar")


class Given:
    """A type whose `evaluate` does what a test gives it."""

    states: tuple[ErrorState, ...] = ()
    values = ("a number",)
    is_absolute = True

    def __init__(self, evaluate: Callable[[MeasurementContext, MeasurementSample], Any]):
        self.evaluate = evaluate


@pytest.fixture(autouse=True)
def types(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Types of this test, and none of packages that are installed."""
    monkeypatch.setattr(MEASUREMENT_TYPES, "_own", {"radar": RADAR})
    monkeypatch.setattr(MEASUREMENT_TYPES, "_all", None)
    monkeypatch.setattr(MEASUREMENT_TYPES, "_find_entry_points", tuple)
    yield MEASUREMENT_TYPES
    MEASUREMENT_TYPES._all = None


def context(own: dict[str, str]) -> MeasurementContext:
    the_rig = rig()
    setup = Setup(the_rig, FilterSettings(), own=own)
    return MeasurementContext(some_nav(setup, 1), setup.layout, setup.settings, the_rig)


def drive(own: dict[str, str], samples: Callable[[ImuSample, float], MeasurementSample | None]) -> Any:
    """Return the filter after 20 s on the IMU and fixes with a sample beside some of the IMU's, and the decisions."""
    run = simulation(figure_eight(speed=3.0, radius=15.0, stationary=4.0), wheel_frames={}, imu_model=QUICK_IMU)
    localizer, decisions = FilterLocalizer.start(Setup(RIG, own=own)), list[Decision]()
    for event in run.events(20.0):
        localizer, events = localizer.process(event)
        decisions += [each for each in events if isinstance(each, Decision)]
        if isinstance(event, ImuSample) and event.header.seq % 10 == 0:
            forward = run.truth(event.header.utime).twist[0][0]
            if (sample := samples(event, forward)) is not None:
                localizer, events = localizer.process(sample)
                decisions += [each for each in events if isinstance(each, Decision)]
    return localizer, decisions


def test_given_a_radar_with_an_error_of_its_scale_then_it_is_fused_and_the_scale_learnt() -> None:
    def measure(event: ImuSample, forward: float) -> MeasurementSample:
        header = replace(event.header, source="front")
        return MeasurementSample(header, (1.06 * forward,), "Car:Imu", (0.05**2,))

    localizer, decisions = drive({"front": "radar", "rear": "radar"}, measure)
    own = [each for each in decisions if each.kind == "radar"]
    assert len(own) > 50
    assert {each.verdict for each in own[-30:]} == {Verdict.USED}
    state = localizer.navigation(localizer.utime)
    # two sources of one type share its states
    assert [name for name in state.names if "radar" in name] == ["radar_scale"]
    assert state.values[state.names.index("radar_scale")] == pytest.approx(0.06, abs=0.02)


def test_given_dead_reckoning_then_what_measures_the_world_is_not_used(types: Any) -> None:
    types.add("beacon", Given(RADAR.evaluate))
    types["beacon"].states = RADAR.states

    def measure(event: ImuSample, forward: float) -> Any:
        if event.header.seq < 300:
            return None
        if event.header.seq == 300:
            return SwitchMode(replace(event.header, source="operator"), Mode.DEAD_RECKONING)
        source = "near" if event.header.seq % 20 else "far"
        return MeasurementSample(replace(event.header, source=source), (forward,))

    _, decisions = drive({"near": "radar", "far": "beacon"}, measure)
    assert {each.source for each in decisions if each.source in ("near", "far")} == {"near"}


@pytest.mark.parametrize(
    ("sample", "word"),
    [
        (MeasurementSample(HEADER, (1.0, 2.0)), "size"),
        (MeasurementSample(HEADER, (math.nan,)), "nan"),
        (MeasurementSample(HEADER, (math.inf,)), "nan"),
        (MeasurementSample(HEADER, (1.0,), "Cart:Nowhere"), "frame"),
    ],
)
def test_given_a_sample_that_its_type_does_not_describe_then_the_word_names_it(
    sample: MeasurementSample, word: str
) -> None:
    assert OwnMeasurement("radar").evaluate(context({"radar": "radar"}), sample) == word


def test_given_a_source_without_a_type_then_it_is_rejected_and_counted() -> None:
    def measure(event: ImuSample, forward: float) -> MeasurementSample:
        return MeasurementSample(replace(event.header, source="stranger"), (forward,))

    _, decisions = drive({}, measure)
    strange = [each for each in decisions if each.source == "stranger"]
    assert strange
    assert {(each.kind, each.verdict, each.reason) for each in strange} == {("own", Verdict.REJECTED, "source")}


def _fail(context: MeasurementContext, sample: MeasurementSample) -> Any:
    raise ZeroDivisionError


def _make(rows: int, columns: int, noise: Any) -> Callable[..., Innovation]:
    return lambda context, sample: Innovation(np.zeros(1), np.zeros((rows, columns or context.layout.size)), noise)


ONE = np.eye(1)


@pytest.mark.parametrize(
    "evaluate",
    [
        _fail,
        lambda context, sample: None,
        lambda context, sample: (1.0, 2.0),
        _make(1, 3, ONE),
        _make(2, 0, ONE),
        _make(1, 0, np.eye(2)),
        _make(1, 0, -ONE),
        _make(1, 0, 0.0 * ONE),
        _make(1, 0, math.nan * ONE),
        lambda context, sample: Innovation(
            np.zeros(2), np.zeros((2, context.layout.size)), np.array([[1.0, 5.0], [5.0, 1.0]])
        ),
        lambda context, sample: Innovation(np.array([math.inf]), np.zeros((1, context.layout.size)), ONE),
        lambda context, sample: Innovation(np.zeros(0), np.zeros((0, context.layout.size)), np.zeros((0, 0))),
    ],
)
def test_given_a_package_that_fails_then_its_samples_are_rejected_and_the_others_used(
    types: Any, evaluate: Callable[..., Any]
) -> None:
    types.add("broken", Given(evaluate))
    found = OwnMeasurement("broken").evaluate(context({"radar": "broken"}), MeasurementSample(HEADER, (1.0,)))
    assert found == "fault"


def test_given_a_package_that_states_why_not_then_that_word_counts(types: Any) -> None:
    types.add("shy", Given(lambda context, sample: "near"))
    assert OwnMeasurement("shy").evaluate(context({"radar": "shy"}), MeasurementSample(HEADER, (1.0,))) == "near"


@pytest.mark.parametrize(
    ("loaded", "why"),
    [
        (type(RADAR), "name an object of it: RADAR = Radar()"),
        (5, "has no method evaluate"),
        (Given, "is a class"),
    ],
)
def test_given_what_is_no_type_then_it_cannot_be_added(types: Any, loaded: object, why: str) -> None:
    with pytest.raises(ValueError, match=re.escape(why)):
        types.add("wrong", loaded)


def test_given_an_incomplete_type_then_the_missing_part_is_named(types: Any) -> None:
    for name, given, why in (
        ("states", [], "tuple of ErrorState"),
        ("values", (), "names as values"),
        ("is_absolute", None, "is_absolute"),
    ):
        made = Given(_fail)
        setattr(made, name, given)
        with pytest.raises(ValueError, match=why):
            types.add("wrong", made)


@pytest.mark.parametrize("state", ["attitude_up", "wheel_scale", "radar_scale"])
def test_given_a_state_that_there_is_already_then_the_vehicle_file_has_a_problem(
    tmp_path: Path, types: Any, state: str
) -> None:
    second = Given(_fail)
    second.states = (ErrorState((state,), sigma=1.0, walk=0.0),)
    types.add("second", second)
    more = AIDING.replace("}}", "}, rear: {channel: REAR, type: second}}")
    with pytest.raises(ConfigError, match=f"type 'second' of an installed package declares the state {state}, which"):
        JournalRig(tmp_path, OPEN.replace("sensors:\n", f"sensors:{more}", 1))


@pytest.mark.parametrize(
    ("stated", "expected"),
    [((), 4.0), ((0.25,), 0.25), ((-1.0,), 4.0), ((0.0,), 4.0), ((math.inf,), 4.0)],
)
def test_given_a_stated_covariance_then_it_is_read_if_it_is_one(stated: tuple[float, ...], expected: float) -> None:
    assert read_covariance(MeasurementSample(HEADER, (1.0,), "", stated), sigma=2.0)[0, 0] == expected


def test_given_a_journal_when_the_package_is_gone_then_the_message_names_the_type(tmp_path: Path, types: Any) -> None:
    journal = JournalRig(tmp_path, OPEN.replace("sensors:\n", f"sensors:{AIDING}", 1))
    for number in range(20):
        journal.send(MeasurementSample(SensorHeader(journal.clock.utime(), "front", number), (0.0,)), "RADAR")
        journal.drive(0.5)
    run = RunState(journal.vehicle.config, journal_state.detach(journal.loop.state))
    data = journal_state.encode_run(run)
    assert journal_state.encode_run(journal_state.decode_run(data)) == data
    del types._own["radar"]
    types._all = None
    with pytest.raises(RecordingError, match="measurements of type radar: no installed package defines it"):
        journal_state.decode_run(data)
    with pytest.raises(ConfigError, match="unknown type 'radar'"):
        JournalRig(tmp_path, OPEN.replace("sensors:\n", f"sensors:{AIDING}", 1))
    with pytest.raises(LookupError):
        get_type("radar")
