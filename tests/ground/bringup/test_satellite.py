"""Tests of the bench steps for power system, GPS receiver and solar strings with scripted devices.

The limits of the diagnosis are tested with values slightly below and above each limit.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flight.schema.devices import Battery, Gps, Power, PowerMonitorSection, SolarString, SolarStringsSection
from ground.bringup.bench import Session, StepSkipped
from ground.bringup.satellite import step_gps, step_power, step_strings
from hal.interfaces.devices import GpsLink, GpsReading, PowerReading, StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from tests.support.bench_session import UTC_NS, ScriptedCoils, bench_session, named

# Power system.

BATTERY, BUS = "power.battery_monitor", "power.bus_monitor"
SECTIONS = {
    "battery_monitor": PowerMonitorSection(address=0x45),
    "bus_monitor": PowerMonitorSection(address=0x46),
}


class ScriptedMonitor:
    """Current monitor of a line with the current `idle` plus `gain` times the current of coil x."""

    def __init__(
        self, session: Session, coils: ScriptedCoils, voltage: float, idle: float, gain: float
    ) -> None:
        self.session, self.coils = session, coils
        self.voltage, self.idle, self.gain = voltage, idle, gain
        self.age_s = 0.1
        self.silent = False

    def latest(self) -> PowerReading | None:
        if self.silent:
            return None
        current = self.idle + self.gain * float(self.coils.now[0])
        now_ns = self.session.rig.clock.now_ns() - round(self.age_s * SECOND_NS)
        return PowerReading(now_ns, self.voltage, current, self.voltage * current, current, now_ns)

    def error(self) -> str:
        return "bus lost" if self.silent else ""


def power_bench(
    battery: tuple[float, float, float], bus: tuple[float, float, float] | None = None
) -> tuple[Session, ScriptedCoils, dict[str, ScriptedMonitor]]:
    """Return a session with monitors of given voltage, current at rest and share of a coil's current."""
    coils = ScriptedCoils()
    sections = SECTIONS if bus is not None else SECTIONS | {"bus_monitor": None}
    devices: dict[str, Any] = {"coils": coils}
    session = bench_session(devices, power=Power(battery=Battery(capacity=2.0), **sections))
    monitors = {BATTERY: ScriptedMonitor(session, coils, *battery)}
    if bus is not None:
        monitors[BUS] = ScriptedMonitor(session, coils, *bus)
    devices |= monitors
    return session, coils, monitors


def test_the_power_step_measures_each_line_without_and_with_the_strongest_current_of_coil_x() -> None:
    session, coils, _ = power_bench((7.6, 0.30, 1.0), (7.5, 0.20, 0.9))
    found = step_power(session)
    section = session.config.coils
    strongest = min(section.limits[0], section.supply_voltage / section.resistance[0])
    assert found.findings == []
    measured = found.values["monitors"]
    assert list(measured) == [BATTERY, BUS]
    assert measured[BATTERY] == pytest.approx({"voltage": 7.6, "current": 0.3, "rise": strongest})
    assert measured[BUS] == pytest.approx({"voltage": 7.5, "current": 0.2, "rise": 0.9 * strongest})
    assert {tuple(command) for command in coils.commands} == {(0.0, 0.0, 0.0), (strongest, 0.0, 0.0)}
    assert coils.commands[0] == coils.commands[-1] == [0.0, 0.0, 0.0]
    # Each current is held for more than two seconds, so that no other current enters the mean of a reading.
    assert session.rig.clock.now_ns() == pytest.approx(2 * 2.6 * SECOND_NS)


STRONGEST = 0.15  # largest current (A) of coil x in these tests


@pytest.mark.parametrize(
    ("battery", "bus", "expected", "says"),
    [
        # A battery of two cells has 6.0 V to 8.36 V; the limits are 5.4 V and 8.78 V.
        ((5.45, 0.3, 1.0), None, [], ""),
        ((5.35, 0.3, 1.0), None, [f"{BATTERY} wrong voltage"], "5.35 V, but the battery has 5.40 to 8.78 V"),
        ((8.75, 0.3, 1.0), None, [], ""),
        ((8.80, 0.3, 1.0), None, [f"{BATTERY} wrong voltage"], "measures 8.80 V"),
        ((7.4, 0.3, 0.0), None, [f"{BATTERY} stuck"], "when a coil is driven (7.40 V, 0.300 A)"),
        ((7.4, 0.3, 0.011 / STRONGEST), None, [], ""),
        ((7.4, 0.3, 0.009 / STRONGEST), None, [f"{BATTERY} no current"], "by 9 mA"),
        ((7.4, 0.3, -0.019 / STRONGEST), None, [f"{BATTERY} no current"], "by -19 mA"),
        ((7.4, 0.3, -0.021 / STRONGEST), None, [f"{BATTERY} reversed"], "falls by 21 mA"),
        ((7.4, 0.3, 1.0), (7.2, 0.3, 1.0), [], ""),
        ((7.4, 0.3, 1.0), (7.15, 0.3, 1.0), [f"{BATTERY} wrong voltage"],
         f"7.40 V here, but {BUS} measures 7.15 V"),
        ((7.15, 0.3, 1.0), (7.4, 0.3, 1.0), [f"{BATTERY} wrong voltage"],
         f"7.15 V here, but {BUS} measures 7.40 V"),
        ((7.4, 0.3, 0.87), (7.4, 0.3, 1.0), [], ""),
        ((7.4, 0.3, 0.83), (7.4, 0.3, 1.0), [f"{BATTERY} wrong shunt"], f"but 150 mA at {BUS}"),
        ((7.4, 0.3, 1.17), (7.4, 0.3, 1.0), [f"{BATTERY} wrong shunt"], "adds 176 mA here"),
        ((7.4, 0.3, 0.5), (7.4, 0.3, 0.0), [f"{BUS} stuck"], ""),
    ],
)  # fmt: skip
def test_a_fault_of_a_monitor_is_named_from_its_limits(
    battery: tuple[float, float, float],
    bus: tuple[float, float, float] | None,
    expected: list[str],
    says: str,
) -> None:
    session, _, monitors = power_bench(battery, bus)
    section = session.config.coils
    scale = STRONGEST / min(section.limits[0], section.supply_voltage / section.resistance[0])
    for monitor in monitors.values():
        monitor.gain *= scale
    found = step_power(session).findings
    assert named(found) == expected
    assert all(says in one.text for one in found)


def test_a_monitor_without_a_new_reading_is_reported_and_not_compared() -> None:
    session, _, monitors = power_bench((7.4, 0.3, 1.0), (7.0, 0.3, 1.0))
    monitors[BATTERY].age_s = 2.7  # older than the step's measurement of 2.6 s
    monitors[BUS].silent = True
    found = step_power(session)
    assert [one.line() for one in found.findings] == [
        f"{BATTERY}: no reading: no conversion arrives: check its supply and wiring",
        f"{BUS}: no reading: bus lost: check its supply and wiring",
    ]
    assert found.values == {"monitors": {}}
    monitors[BATTERY].age_s = 2.5
    assert list(step_power(session).values["monitors"]) == [BATTERY]


def test_the_guardian_of_the_coils_is_kept_awake() -> None:
    session, coils, _ = power_bench((7.4, 0.3, 1.0))
    beats: list[int] = []
    session.guardian = SimpleNamespace(beat=lambda: beats.append(len(coils.commands)), tend=lambda now_ns: [])
    step_power(session)
    assert beats == list(range(1, len(coils.commands)))  # each command but the final zero


def test_a_configuration_without_power_system_skips_the_step() -> None:
    with pytest.raises(StepSkipped, match="the configuration has no section `power`"):
        step_power(bench_session({}, power=None))


# GPS receiver.


class ScriptedReceiver:
    """GPS receiver that returns given readings when the clock reaches their arrival."""

    def __init__(self, readings: list[GpsReading], link: GpsLink | None = None) -> None:
        self.session: Session | None = None
        self.waiting = list(readings)
        self.end = link or GpsLink(frames=len(readings))
        self.asked = 0

    def poll(self) -> list[GpsReading]:
        assert self.session is not None
        now_ns = self.session.rig.clock.now_ns()
        due = [one for one in self.waiting if one.arrival_ns <= now_ns]
        self.waiting = self.waiting[len(due) :]
        return due

    def link(self) -> GpsLink:
        """Return counters, which are 0 at the first call and `end` afterwards."""
        self.asked += 1
        return GpsLink() if self.asked == 1 else self.end


VELOCITY = np.array([7000.0, -2000.0, 500.0])


def fixes(count: int = 12, *, period: float = 1.0, late: float = 0.15, **changes: Any) -> list[GpsReading]:
    """Return fixes of a receiver that moves with a constant velocity, each `late` s after its epoch."""
    found = []
    for number in range(count):
        epoch = 0.5 + period * number
        arrival_ns = round((epoch + late) * SECOND_NS)
        reading = GpsReading(
            arrival_ns,
            arrival_ns,
            UTC_NS + round(epoch * SECOND_NS),
            np.array([1e6, 2e6, 6e6]) + epoch * VELOCITY,
            VELOCITY,
            math.nan,
            math.nan,
            min(4 + number, 9),
            True,
        )
        found.append(replace(reading, **changes))
    return found


def gps(readings: list[GpsReading], link: GpsLink | None = None, **section: Any) -> Any:
    receiver = ScriptedReceiver(readings, link)
    session = bench_session({"gps": receiver}, gps=Gps(**section))
    receiver.session = session
    return step_gps(session)


def test_twelve_fixes_state_number_satellites_and_delay() -> None:
    found = gps(fixes(20))
    assert found.findings == []
    assert found.values == {"fixes": 12, "satellites": 9, "offset_s": pytest.approx(0.15)}


def test_the_interval_of_the_fixes_is_that_of_the_configuration() -> None:
    assert gps(fixes(period=5.0), period=5.0).findings == []
    assert named(gps(fixes(period=1.0), period=5.0).findings) == ["gps wrong rate"]
    assert gps(fixes(period=1.0), period=5.0, driver="nmea").findings == []
    late = [replace(one, arrival_ns=one.arrival_ns + 10 * SECOND_NS) for one in fixes(3, period=10.0)]
    assert named(gps(late, GpsLink(), period=10.0).findings) == ["gps wrong time"], "not given up after 6 s"


def moved(by_m: float, sigma: float) -> list[GpsReading]:
    """Return fixes of which the sixth is displaced."""
    readings = [replace(one, sigma=sigma) for one in fixes()]
    readings[5] = replace(readings[5], position=readings[5].position + np.array([0.0, by_m, 0.0]))
    return readings


def accelerated() -> list[GpsReading]:
    """Return fixes without jumps, of a receiver with a constant acceleration of 100 m/s^2."""
    found = []
    for one in fixes():
        t = (one.utc_ns - UTC_NS) * 1e-9
        along = np.array([0.0, 0.0, 100.0])
        found.append(
            replace(one, position=one.position + 0.5 * t**2 * along, velocity=one.velocity + t * along)
        )
    return found


def paused(pause: float, base: list[GpsReading]) -> list[GpsReading]:
    """Return fixes with a pause of this duration (s) before the sixth fix."""
    more = round((pause - 1.0) * SECOND_NS)
    return base[:5] + [
        replace(one, arrival_ns=one.arrival_ns + more, utc_ns=one.utc_ns + more,
                position=one.position + more * 1e-9 * VELOCITY)
        for one in base[5:]
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("readings", "kinds", "says"),
    [
        (fixes(late=0.68), [], ""),
        (fixes(late=0.72), ["late"], "a fix arrives 0.7 s after its time stamp"),
        (fixes(late=4.8), ["late"], "4.8 s after"),
        (fixes(late=5.2), ["wrong time"], "by -5 s"),
        ([replace(one, utc_ns=one.utc_ns + 60 * SECOND_NS) for one in fixes()], ["wrong time"], "by 60 s"),
        (fixes(period=0.65), [], ""),
        (fixes(period=0.55), ["wrong rate"], "every 0.55 s instead of every 1 s"),
        (fixes(period=1.45), [], ""),
        (fixes(period=1.55), ["wrong rate"], "every 1.55 s"),
        (paused(2.4, fixes()), [], ""),
        (paused(2.6, fixes()), ["intermittent"], "stop for up to 2.6 s"),
        (moved(48.0, 2.0), [], ""),
        (moved(60.0, 2.0), [], ""),
        (moved(64.0, 2.0), ["inconsistent"], "jumps by 64 m more"),
        (moved(48.0, math.nan), [], ""),
        (moved(52.0, math.nan), ["inconsistent"], "jumps by 52 m more"),
        (accelerated(), [], ""),
        (fixes(utc_ns=UTC_NS), ["stuck"], "its time does not advance in 12 fixes"),
    ],
)  # fmt: skip
def test_a_fault_of_the_receiver_is_named_from_its_fixes(
    readings: list[GpsReading], kinds: list[str], says: str
) -> None:
    found = gps(readings).findings
    assert named(found) == [f"gps {kind}" for kind in kinds]
    assert all(says in one.text for one in found)


@pytest.mark.parametrize(
    ("link", "kinds", "says"),
    [
        (GpsLink(frames=98, bad_checksum=2), [], ""),
        (GpsLink(frames=97, bad_checksum=3), ["corrupted messages"], "3 % of the messages"),
        (GpsLink(frames=17, sentences=80, bad_checksum=3), ["corrupted messages"], "3 % of the messages"),
    ],
)
def test_two_percent_of_wrong_checksums_are_allowed(link: GpsLink, kinds: list[str], says: str) -> None:
    found = gps(fixes(), link).findings
    assert named(found) == [f"gps {kind}" for kind in kinds]
    assert all(says in one.text for one in found)


def test_pauses_of_a_corrupted_stream_are_not_loose_contacts() -> None:
    found = gps(paused(2.6, fixes()), GpsLink(frames=90, bad_checksum=10))
    assert named(found.findings) == ["gps corrupted messages"]


def test_a_silent_receiver_is_given_up_soon_and_one_without_a_fix_late() -> None:
    silent = gps([], GpsLink(condition="antenna short"))
    assert named(silent.findings) == ["gps no answer"]
    assert silent.findings[0].text == "no navigation solution arrives in 7 s: antenna short"
    assert silent.values == {"fixes": 0, "satellites": 0, "offset_s": None}
    sends_other = gps([], GpsLink(frames=5))
    assert sends_other.findings[0].text == "no navigation solution arrives in 120 s: check its output"
    searching = gps(fixes(130, valid=False))
    assert named(searching.findings) == ["gps no fix"]
    assert searching.findings[0].text == "no fix in 120 s, with 9 satellites"
    assert searching.values == {"fixes": 0, "satellites": 9, "offset_s": None}


def test_three_messages_do_not_determine_a_rate() -> None:
    few = fixes(3, period=40.0)
    assert named(gps(few).findings) == []
    assert named(gps(fixes(4, period=25.0)).findings) == ["gps wrong rate"]


# Solar strings.

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
STRINGS = SolarStringsSection(
    strings=(
        SolarString(normal=X, channel=0, peak=0.5),
        SolarString(normal=Y, channel=1, peak=1.0),
        SolarString(normal=Z, channel=2, peak=0.2),
    )
)
SUNLIT = np.diag([0.4, 0.8, 0.16])


class ScriptedStrings:
    """Solar strings whose currents are `matrix` times the lamp's direction, plus the currents in the dark."""

    def __init__(self, matrix: FloatArray, dark: FloatArray) -> None:
        self.matrix, self.dark = matrix, dark
        self.lamp = np.zeros(3)
        self.age_s = 0.1
        self.session: Session | None = None
        self.lamps: list[list[float]] = []

    def light(self, normal: FloatArray) -> None:
        """Point the lamp along `normal`, as the emulated hand does."""
        self.lamp = normal
        self.lamps.append(normal.tolist())

    def latest(self) -> StringReading | None:
        assert self.session is not None
        now_ns = self.session.rig.clock.now_ns() - round(self.age_s * SECOND_NS)
        return None if self.age_s < 0 else StringReading(now_ns, self.matrix @ self.lamp + self.dark)

    def error(self) -> str:
        return "" if self.age_s > 0 else "bus lost"


def strings_bench(
    matrix: FloatArray, dark: Any = 0.0, section: SolarStringsSection = STRINGS
) -> tuple[Session, ScriptedStrings]:
    strings = ScriptedStrings(np.asarray(matrix, dtype=float), dark * np.ones(len(section.strings)))
    session = bench_session({"solar_strings": strings}, solar_strings=section)
    strings.session = session
    session.hand = strings
    return session, strings


PERMUTED = SUNLIT[[1, 0, 2]]


@pytest.mark.parametrize(
    ("matrix", "dark", "expected", "says"),
    [
        (SUNLIT, 0.0, [], ""),
        (SUNLIT, [0.024, 0.0, 0.0], [], ""),
        (SUNLIT, [0.026, 0.0, 0.0], ["[0] current in the dark"], "26 mA in the dark"),
        (SUNLIT, [0.0, 0.0, 0.011], ["[2] current in the dark"], "11 mA in the dark"),
        (np.diag([0.4, 0.031, 0.16]), 0.0, [], ""),
        (np.diag([0.4, 0.029, 0.16]), 0.0, ["[1] dead"], "a lamp on its panel gives 29 mA"),
        (PERMUTED, 0.0, ["[0] exchanged", "[1] exchanged"], "gives a current in string"),
        # Stray light on a string with a larger peak current is not mistaken for an exchange of strings.
        (SUNLIT + 0.5 * np.outer(Y, X), 0.0, [], ""),
    ],
)  # fmt: skip
def test_a_fault_of_a_solar_string_is_named(matrix: Any, dark: Any, expected: list[str], says: str) -> None:
    found = step_strings(strings_bench(matrix, np.array(dark))[0]).findings
    assert named(found) == [f"solar_strings.strings{one}" for one in expected]
    assert all(says in one.text for one in found)


def test_the_currents_of_each_lamp_are_those_above_the_dark_currents() -> None:
    session, strings = strings_bench(SUNLIT, np.array([0.01, 0.02, 0.0]))
    found = step_strings(session)
    assert np.array(found.values["currents"]) == pytest.approx(SUNLIT)
    assert strings.lamps == [[0.0, 0.0, 0.0], list(X), list(Y), list(Z)]
    (first, second) = step_strings(strings_bench(PERMUTED)[0]).findings
    assert first.text == "a lamp on its panel gives a current in string 2"
    assert second.text == "a lamp on its panel gives a current in string 1"


def test_strings_on_the_same_panel_are_not_exchanged() -> None:
    pair = SolarStringsSection(strings=(*STRINGS.strings[:2], SolarString(normal=Y, channel=2, peak=0.2)))
    both = np.array([[0.4, 0.0, 0.0], [0.0, 0.8, 0.0], [0.0, 0.19, 0.0]])
    assert step_strings(strings_bench(both, section=pair)[0]).findings == []


def test_strings_whose_currents_never_change_are_stuck() -> None:
    (found,) = step_strings(strings_bench(np.zeros((3, 3)), np.array([0.01, 0.03, 0.0]))[0]).findings
    assert (found.part, found.kind) == ("solar_strings", "stuck")
    assert "largest 30 mA" in found.text


@pytest.mark.parametrize(("age_s", "problem"), [(1.3, "no conversion arrives"), (-1.0, "bus lost")])
def test_an_old_reading_of_the_strings_ends_the_step(age_s: float, problem: str) -> None:
    session, strings = strings_bench(SUNLIT)
    strings.age_s = age_s
    with pytest.raises(StepSkipped, match="the solar strings give no reading") as ended:
        step_strings(session)
    assert ended.value.finding is not None
    assert (ended.value.finding.kind, ended.value.finding.text) == ("no reading", problem)
    strings.age_s = 1.2  # the reading is from the second half of the 2.5 s
    assert step_strings(session).findings == []
