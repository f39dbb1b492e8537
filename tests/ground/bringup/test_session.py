"""Tests of the bench steps for the inertial unit and the coils with scripted devices."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flight.schema import reader
from flight.schema.devices import Coils, Winding
from ground.bringup.bench import Outcome, Session, StepSkipped
from ground.bringup.diagnosis import CoilsFound, Finding
from ground.bringup.session import (
    STEPS,
    _coil_changes,
    expectation,
    step_axes,
    step_coils,
    step_find,
    step_rest,
)
from hal.interfaces.guardian import GuardianNews
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from tests.support.bench_session import ScriptedCoils, ScriptedUnit, bench_session, named
from tests.support.orbit_devices import orbit_config

G = 9.80665
SITE = np.array([2e-5, 0.0, -4e-5])

# Inertial unit.


def test_the_expected_noise_is_that_of_the_data_sheet_at_the_sample_rate() -> None:
    """VN-100: 0.0035 deg/s, 14 nT and 0.14 mg per root hertz, in a bandwidth of half the sample rate."""
    config = orbit_config()
    config = reader.replace(
        config, inertial_unit=reader.replace(config.inertial_unit, rate_hz=50.0, rate_noise=1e-9)
    )
    found = expectation(config)
    assert found.rate_hz == 50.0
    assert found.gyro == pytest.approx(math.radians(0.0035) * 5.0)
    assert found.field == pytest.approx(70e-9)
    assert found.acceleration == pytest.approx(0.14e-3 * G * 5.0)
    noisy = reader.replace(config, inertial_unit=reader.replace(config.inertial_unit, rate_noise=0.01))
    assert expectation(noisy).gyro == 0.01
    other: Any = SimpleNamespace(inertial_unit=SimpleNamespace(driver="mine", rate_hz=20.0, rate_noise=2e-3))
    found = expectation(other)
    assert (found.rate_hz, found.gyro, found.field, found.acceleration) == (20.0, 2e-3, 1e-6, 0.05)
    other.inertial_unit.rate_noise = 1e-5
    assert expectation(other).gyro == 1e-3


def at_rest(
    *, bias: float = 0.0, field: FloatArray = SITE, counts: dict[str, Any] | None = None
) -> tuple[Session, ScriptedUnit]:
    """Return a session with a unit at rest whose noise is that of its data sheet."""
    config = orbit_config()
    expected = expectation(config)
    noise = np.random.default_rng(3).normal(size=(2000, 3, 3))

    def sample(number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        gyro, magnetic, force = noise[number]
        return (
            np.array([bias, 0.0, 0.0]) + expected.gyro * gyro,
            field + expected.field * magnetic,
            np.array([0.0, 0.0, G]) + expected.acceleration * force,
        )

    unit = ScriptedUnit(lambda: session, sample, **(counts or {"packets": 480}))
    session = bench_session({"inertial_unit": unit})
    return session, unit


def test_the_rest_step_states_rate_noise_and_means_and_corrects_the_noise() -> None:
    session, _ = at_rest(bias=0.01)
    found = step_rest(session)
    expected = expectation(session.config)
    assert found.findings == []
    assert found.values["rate_hz"] == pytest.approx(40.0)
    assert found.values["noise"]["gyro"] == pytest.approx([expected.gyro] * 3, rel=0.15)
    assert found.values["noise"]["field"] == pytest.approx([expected.field] * 3, rel=0.15)
    assert found.values["noise"]["acceleration"] == pytest.approx([expected.acceleration] * 3, rel=0.15)
    assert found.values["expected"] == {
        "gyro": expected.gyro, "field": expected.field, "acceleration": expected.acceleration,
    }  # fmt: skip
    assert found.values["bias"] == pytest.approx([0.01, 0.0, 0.0], abs=1e-4)
    assert found.values["field"] == pytest.approx(SITE.tolist(), abs=1e-7)
    assert found.values["acceleration"] == pytest.approx([0.0, 0.0, G], abs=0.01)
    assert found.changes == {
        "inertial_unit": {"rate_noise": pytest.approx(max(found.values["noise"]["gyro"]), abs=1e-9)}
    }
    assert found.arrays["times"][0] == 0.0
    assert found.arrays["times"][-1] == pytest.approx(12.0, abs=0.05)
    assert found.arrays["rate"].shape == found.arrays["field"].shape == (480, 3)
    assert found.arrays["allan_times"][:2] == pytest.approx([0.025, 0.05])
    assert found.arrays["allan"][0] == pytest.approx([expected.gyro] * 3, rel=0.15)
    assert session.rig.clock.now_ns() == 12 * SECOND_NS


def test_faults_at_rest_keep_the_configured_noise() -> None:
    found = step_rest(at_rest(bias=0.03)[0])
    assert named(found.findings) == ["inertial_unit.gyro biased"]
    assert found.changes == {}


@pytest.mark.parametrize(("packets", "wrong", "kinds"), [(480, 4, []), (480, 6, ["corrupted packets"])])
def test_the_share_of_wrong_checksums_is_that_of_all_packets(
    packets: int, wrong: int, kinds: list[str]
) -> None:
    found = step_rest(at_rest(counts={"packets": packets, "bad_checksum": wrong})[0])
    assert named(found.findings) == [f"inertial_unit {kind}" for kind in kinds]
    assert all(f"{100.0 * wrong / (packets + wrong):.1f} %" in one.text for one in found.findings)


@pytest.mark.parametrize(("size", "plant", "fault"), [(7.4e-5, None, False), (7.6e-5, None, True),
                                                      (3.8e-4, 3e-4, False), (4e-4, 3e-4, True)])  # fmt: skip
def test_a_field_up_to_1_3_times_that_of_the_cage_is_expected(
    size: float, plant: float | None, fault: bool
) -> None:
    session, _ = at_rest(field=np.array([0.0, 0.0, size]))
    config = session.config
    unit = config.inertial_unit
    fake: Any = SimpleNamespace(
        inertial_unit=unit, plant=None if plant is None else SimpleNamespace(field=plant)
    )
    session.config = fake
    assert ("inertial_unit.magnetometer wrong scale" in named(step_rest(session).findings)) == fault


def test_few_samples_are_counted_and_not_evaluated() -> None:
    session, unit = at_rest()
    unit.rate_hz = 1.5
    found = step_rest(session)
    assert found.values == {"samples": 18}
    assert found.changes == {}


class Hand:
    """Emulated hand that rotates the body with a constant rate."""

    def __init__(self) -> None:
        self.turns: list[tuple[list[float], float, float]] = []
        self.body = np.eye(3)
        self.rate = np.zeros(3)

    def turn(self, axis: FloatArray, angle: float, seconds: float) -> None:
        self.turns.append((axis.tolist(), angle, seconds))
        self.body = attitude_matrix(from_rotation_vector(angle * axis))
        self.rate = angle * axis


def test_the_axes_step_measures_each_rotation_by_the_hand() -> None:
    """The body is rotated at once, and the gyro measures the whole angle in the first sample afterwards."""
    hand = Hand()
    bias = np.array([0.01, -0.02, 0.03])

    def sample(number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        turned, hand.rate = hand.rate, np.zeros(3)
        return bias + turned * 40.0, hand.body @ SITE, hand.body @ np.array([0.0, 0.0, G])

    unit = ScriptedUnit(lambda: session, sample)
    session = bench_session({"inertial_unit": unit})
    asked: list[str] = []
    session.hand, session.ask = hand, asked.append
    # The integral of the rate begins at the first sample of a record, so the rotation waits for two samples.
    whole = hand.turn

    def late(axis: FloatArray, angle: float, seconds: float) -> None:
        whole(axis, angle, seconds)
        hand.rate = np.zeros(3)
        pending.append((axis, angle))

    pending: list[tuple[FloatArray, float]] = []
    plain = unit.sample
    count = [0]

    def delayed(number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        if pending:
            count[0] += 1
            if count[0] == 3:
                axis, angle = pending.pop()
                pending.clear()
                count[0] = 0
                hand.rate = angle * axis
        return plain(number)

    unit.sample = delayed
    hand.turn = late  # type: ignore[method-assign]
    found = step_axes(session)
    assert found.findings == []
    assert np.array(found.values["turns_deg"]) == pytest.approx(90.0 * np.eye(3), abs=0.5)
    assert found.values["axes"] == dict.fromkeys(
        ("gyro", "accelerometer", "magnetometer"), np.eye(3).tolist()
    )
    assert found.changes == {}
    assert found.arrays["turns"] == pytest.approx(0.5 * math.pi * np.eye(3), abs=0.01)
    quarter = 0.5 * math.pi
    rows = np.eye(3).tolist()
    assert hand.turns == [
        (rows[0], 0.0, 1.0), (rows[0], quarter, 2.0),
        (rows[1], 0.0, 1.0), (rows[1], quarter, 2.0),
        (rows[2], 0.0, 1.0), (rows[2], quarter, 2.0),
        (rows[0], 0.0, 1.0),
    ]  # fmt: skip
    assert "turn it right-handed by 90 deg about its y axis within 0.5 s" in asked[1]


def test_the_steps_are_in_the_order_of_a_session() -> None:
    assert list(STEPS)[:5] == ["find", "rest", "axes", "coils", "power"]


def test_the_find_step_lists_each_answer_and_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    fault = Finding("gps", "no answer", "", "")
    rows = [
        SimpleNamespace(part="coils", place="bus, 0x40", answer="opens", finding=None),
        SimpleNamespace(part="gps", place="/dev/gps", answer="", finding=fault),
    ]
    monkeypatch.setattr("ground.bringup.session.find", lambda *words: iter(rows))
    found = step_find(bench_session({}))
    assert found.findings == [fault]
    assert found.values == {"answers": {"coils": "bus, 0x40: opens", "gps": "/dev/gps: no answer"}}


# Coils.

FIELD = 5e-4 * np.array([[1.0, 0.1, 0.0], [0.0, 1.1, -0.1], [0.1, 0.0, 0.9]])
"""Field (T/A) of each coil at the magnetometer."""


class Bench:
    """Coils whose fields a magnetometer measures without delay, and a monitor of their supply."""

    def __init__(
        self, *, idle: float = 0.004, gain: float = 1.0, fault: str = "", swing: float = 0.0
    ) -> None:
        self.idle, self.gain, self.fault = idle, gain, fault
        self.coils = Driven(self)
        noise = np.random.default_rng(4).normal(size=(4000, 3))

        def sample(number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
            phase = 2.0 * np.pi * number / 800.0  # a period of 20 s
            body = attitude_matrix(from_rotation_vector(np.array([swing * np.sin(phase), 0.0, 0.0])))
            field = body @ SITE + self.coils.now[:3] @ FIELD + 1e-8 * noise[number]
            rate = np.array([swing * np.cos(phase) * 2.0 * np.pi / 20.0, 0.0, 0.0])
            return rate, field, np.array([0.0, 0.0, G])

        self.unit = ScriptedUnit(lambda: self.session, sample)
        self.beats = 0
        self.news: list[GuardianNews] = []
        self.clipped = False
        self.session = bench_session({"coils": self.coils, "inertial_unit": self.unit, "power_monitor": self})
        self.session.coil_field = FIELD
        self.session.guardian = self

    def beat(self) -> None:
        self.beats += 1

    def tend(self, now_ns: int) -> list[GuardianNews]:
        news, self.news = self.news, []
        return news

    def latest(self) -> Any:
        now_ns = self.session.rig.clock.now_ns()
        current = self.idle + self.gain * float(np.abs(self.coils.now).sum())
        return SimpleNamespace(
            time_ns=now_ns, newest=current, newest_since_ns=now_ns, clipped=self.clipped,
            voltage=5.0 - current,
        )  # fmt: skip

    def error(self) -> str:
        return "bus lost"


class Driven(ScriptedCoils):
    """Coils that record the braked bridges, and report a failure that the test sets."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench, self.braked, self.offs = bench, list[frozenset[int]](), 0

    def state(self) -> Any:
        return SimpleNamespace(error=self.bench.fault)

    def off(self) -> None:
        super().off()
        self.offs += 1

    def brake(self, bridges: frozenset[int]) -> None:
        self.braked.append(bridges)


def test_the_coil_step_drives_each_coil_in_both_directions_and_states_field_and_current() -> None:
    bench = Bench()
    found = step_coils(bench.session)
    section = bench.session.config.coils
    strongest = np.minimum(section.limits, section.supply_voltage / np.array(section.resistance))[:3]
    assert found.findings == []
    assert found.values["commanded"] == pytest.approx(strongest.tolist())
    assert np.array(found.values["response"]) == pytest.approx(FIELD, rel=0.02, abs=2e-6)
    assert found.values["strength"] == pytest.approx([1.0] * 3, abs=0.02)
    assert found.values["serves"] == [0, 1, 2]
    assert np.array(found.values["current"]) == pytest.approx(
        np.repeat(strongest[:, None], 2, axis=1), abs=1e-5
    )
    assert found.values["volts"] == pytest.approx([4.996, 4.996 - max(strongest)], abs=1e-3)
    assert found.values["expected"] == "configured"
    assert found.changes == {}
    assert found.arrays["response"] == pytest.approx(FIELD, rel=0.02, abs=2e-6)
    assert found.arrays["expected"] == pytest.approx(FIELD)
    assert found.arrays["commanded"] == pytest.approx(strongest)
    driven = list(dict.fromkeys(map(tuple, bench.coils.commands)))
    zero = (0.0, 0.0, 0.0)
    each = [tuple(sign * strongest * row) for row in np.eye(3) for sign in (1.0, -1.0)]
    assert driven[0] == zero
    assert np.array(driven[1:]) == pytest.approx(np.array(each))
    assert bench.coils.commands[-1] == list(zero)
    assert bench.coils.offs == 1
    assert bench.coils.braked == []
    assert bench.beats == len(bench.coils.commands) - 1


def test_a_current_while_the_coils_are_off_is_braked_and_a_refused_command_is_reported_first() -> None:
    bench = Bench(idle=0.05, fault="no acknowledge")
    found = step_coils(bench.session)
    assert named(found.findings) == ["coils refused", "coils current while off"]
    assert found.findings[0].text == "no acknowledge"
    assert bench.coils.braked == [frozenset({0, 1, 2})]


def test_the_guardian_does_not_release_the_brake_of_a_leg_that_is_stuck_high() -> None:
    """Without heartbeats for 0.3 s, the guardian would set the inputs of the bridges to low."""
    bench = Bench(idle=0.05)
    step_coils(bench.session)
    beats = bench.beats
    bench.session.wait(2.0)
    assert bench.beats - beats >= 20
    bench.session.stack.close()
    beats = bench.beats
    bench.session.wait(2.0)
    assert bench.beats == beats, "the session has ended"
    sound = Bench()
    step_coils(sound.session)
    beats = sound.beats
    sound.session.wait(2.0)
    assert sound.beats == beats, "no bridge is braked"


def test_a_guardian_that_dies_is_replaced_and_reported_once() -> None:
    bench = Bench()
    bench.news = [GuardianNews.READY, GuardianNews.LOST, GuardianNews.ACTED]
    assert step_coils(bench.session).findings == []
    assert [one.kind for one in bench.session.lost_guardians()] == ["died"]
    assert bench.session.lost_guardians() == []


def test_coils_of_a_body_that_moves_are_not_judged() -> None:
    """A body that swings by 30 deg changes the measured field by more than 10 % of a coil's field."""
    found = step_coils(Bench(swing=np.radians(30.0)).session)
    assert named(found.findings) == ["coils moved"]
    assert "rotated by" in found.findings[0].text
    assert found.changes == {}
    assert step_coils(Bench(swing=np.radians(0.2)).session).findings == []


def test_a_monitor_without_readings_is_reported_and_the_fields_are_compared() -> None:
    bench = Bench()
    bench.latest = lambda: None  # type: ignore[method-assign]
    found = step_coils(bench.session)
    assert [one.line() for one in found.findings] == [
        "power_monitor: no reading: bus lost: check its supply and wiring"
    ]
    assert found.values["current"] == [[None, None]] * 3
    assert found.values["volts"] == [None, None]
    assert found.values["strength"] == pytest.approx([1.0] * 3, abs=0.02)


def test_readings_from_before_the_current_settled_do_not_count() -> None:
    """An ADC sample that begins before the change of the current measures 9 A."""
    bench = Bench()
    latest, command = bench.latest, bench.coils.command
    changed_ns = [0]

    def noted(currents: FloatArray) -> None:
        if not np.array_equal(currents, bench.coils.now):
            changed_ns[0] = bench.session.rig.clock.now_ns()
        command(currents)

    def slow() -> Any:
        reading = latest()
        reading.newest_since_ns -= round(0.4 * SECOND_NS)
        reading.newest += 9.0 * (reading.newest_since_ns < changed_ns[0])
        return reading

    bench.coils.command = noted  # type: ignore[method-assign]
    bench.latest = slow  # type: ignore[method-assign]
    assert step_coils(bench.session).findings == []


def test_the_coils_are_off_after_an_interruption() -> None:
    bench = Bench()

    def lost() -> None:
        if len(bench.coils.commands) > 100:
            raise StepSkipped("interrupted")

    bench.beat = lost  # type: ignore[method-assign]
    with pytest.raises(StepSkipped, match="interrupted"):
        step_coils(bench.session)
    assert bench.coils.commands[-1] == [0.0, 0.0, 0.0]
    assert bench.coils.offs == 1


EXCHANGED = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("known", "kinds"),
    [
        ({}, ["coils.windings[1] wrong strength"]),
        ({"axes": Outcome([Finding("inertial_unit.magnetometer", "wrong scale", "", "")])}, []),
        ({"axes": Outcome([Finding("inertial_unit.gyro", "wrong scale", "", "")])},
         ["coils.windings[1] wrong strength"]),
        ({"rest": Outcome([Finding("inertial_unit.magnetometer", "stuck", "", "")])},
         ["inertial_unit.magnetometer no response"]),
        ({"rest": Outcome([Finding("inertial_unit.magnetometer", "noisy", "", "")])},
         ["coils.windings[1] wrong strength"]),
        ({"axes": Outcome(values={"axes": {"magnetometer": EXCHANGED}})}, None),
    ],
)  # fmt: skip
def test_the_findings_of_earlier_steps_are_considered(
    known: dict[str, Outcome], kinds: list[str] | None
) -> None:
    bench = Bench()
    bench.session.coil_field = FIELD * np.array([[1.0], [0.6], [1.0]])
    bench.session.known = known
    found = step_coils(bench.session)
    if kinds is None:
        exchanged = FIELD[:, [1, 0, 2]]
        assert np.array(found.values["response"]) == pytest.approx(exchanged, rel=0.02, abs=2e-6)
    else:
        assert named(found.findings) == kinds


# Changes of the configuration.


def wound() -> Any:
    config = orbit_config()
    section = Coils(
        windings=(
            Winding(axis=(1.0, 0.0, 0.0), resistance=20.0, channels=(0, 1)),
            Winding(axis=(0.0, 1.0, 0.0), resistance=30.0, channels=(2, 3), sign=-1),
            Winding(axis=(0.0, 0.0, 1.0), resistance=40.0, channels=(4, 5)),
        ),
        supply_voltage=5.0,
        current_limit=0.1,
    )
    return reader.replace(config, coils=section)


def changes(
    *findings: Finding, serves: tuple[int, ...] = (0, 1, 2), strength: tuple[float, ...] = (1.0, 1.0, 1.0),
    shunt: float = 1.0, clipped: bool = False, axes_known: bool = True,
) -> dict[str, Any]:  # fmt: skip
    response = np.array([[0.0, 3e-4, 4e-4], [0.0, 5e-4, 0.0], [0.0, 0.0, 5e-4]])
    nothing = np.zeros(3)
    values = response, response, list(serves), np.array(strength), nothing, nothing > 0, nothing
    found = CoilsFound(*values, shunt, {}, 0.2, list(findings))
    return _coil_changes(wound(), found, clipped, axes_known=axes_known)


def fault(number: int, kind: str, factor: float | None = None) -> Finding:
    return Finding(f"coils.windings[{number}]", kind, "", "", factor)


def changed(found: dict[str, Any], key: str) -> list[Any]:
    return [one.get(key) for one in found["coils"]["windings"]]


def test_faults_without_a_cure_in_the_configuration_change_nothing() -> None:
    assert changes() == {}
    assert changes(fault(0, "open"), fault(1, "short"), fault(2, "wrong strength")) == {}


def test_a_reversed_coil_changes_its_sign() -> None:
    found = changes(fault(1, "reversed"), strength=(1.0, -1.0, 1.0))
    assert changed(found, "sign") == [1, 1, 1]
    assert changed(found, "channels") == [[0, 1], [2, 3], [4, 5]]
    found = changes(fault(2, "reversed"), strength=(1.0, 1.0, -1.0))
    assert changed(found, "sign") == [1, -1, -1]


def test_exchanged_coils_exchange_their_channels_and_keep_their_resistance() -> None:
    found = changes(fault(0, "exchanged"), fault(1, "exchanged"), serves=(1, 0, 2), strength=(-1.0, 1.0, 1.0))
    assert changed(found, "channels") == [[2, 3], [0, 1], [4, 5]]
    # The command of coil x drives coil y in reverse: coil y gets the pins of x with the reversed sign of x.
    assert changed(found, "sign") == [-1, -1, 1]
    assert changed(found, "resistance") == [20.0, 30.0, 40.0]


def test_a_wrong_resistance_is_multiplied_by_its_factor() -> None:
    found = changes(fault(2, "wrong resistance", 1.5))
    assert changed(found, "resistance") == [20.0, 30.0, 60.0]


def test_exchanged_coils_of_different_resistance_keep_their_resistance() -> None:
    """The command of coil x drives coil y, of 30 ohm, with the duty cycle for 20 ohm, and vice versa."""
    swapped = changes(
        fault(0, "exchanged"),
        fault(1, "exchanged"),
        fault(0, "wrong resistance", 30.0 / 20.0),
        fault(1, "wrong resistance", 20.0 / 30.0),
        serves=(1, 0, 2),
    )
    assert changed(swapped, "resistance") == [20.0, 30.0, 40.0]


def test_a_tilted_coil_changes_its_axis_unless_its_field_is_not_along_its_axis() -> None:
    found = changes(fault(0, "wrong direction"))
    assert list(map(list, changed(found, "axis"))) == [[0.0, 0.6, 0.8], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert changes(fault(0, "wrong direction"), axes_known=False) == {}
    reversed_sign = changes(fault(1, "wrong direction"))
    assert reversed_sign["coils"]["windings"][1]["axis"] == [0.0, -1.0, 0.0]


@pytest.mark.parametrize(
    ("kind", "clipped", "expected"),
    [("wrong shunt", False, True), ("wrong shunt", True, False), ("reversed", False, False)]
)  # fmt: skip
def test_a_wrong_shunt_is_corrected_unless_the_monitor_is_out_of_range(
    kind: str, clipped: bool, expected: bool
) -> None:
    found = changes(Finding("power_monitor", kind, "", ""), shunt=0.20413, clipped=clipped)
    shunt = orbit_config().power_monitor
    assert shunt is not None
    assert found == ({"power_monitor": {"shunt": float(f"{shunt.shunt * 0.20413:.3g}")}} if expected else {})
