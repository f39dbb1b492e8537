"""Tests of the syntax of faults, and of the error messages for invalid faults."""

from __future__ import annotations

from pathlib import Path

import pytest

from flight.app.cli import main
from flight.schema import reader as configuration
from flight.schema.document import ConfigError
from knightcube.errors import UsageError
from sim_hal.faults.catalogue import CATALOGUE, FaultKind, listing
from sim_hal.faults.schedule import check, entries, parse, schedule, scheduled
from sim_hal.settings import FaultEntry, Simulation
from tests.support.flights import CONFIG, TEXT, demo_config

DEVICES = {
    "imu",
    "battery",
    "battery-monitor",
    "bus-monitor",
    "panels",
    "magnetometer",
    "pwm",
    "monitor",
    "bus",
    "camera",
    "gps",
    "strings",
    "wide",
    "planner",
    "vision",
    "process",
    "clock",
    "disk",
    "config",
}


@pytest.mark.parametrize(
    ("text", "name", "at", "span", "parameters"),
    [
        ("imu: silent @ 120 for 5", "imu: silent", 120.0, 5.0, {}),
        ("imu:silent", "imu: silent", 0.0, None, {}),
        ("  IMU : Delayed ( delay = 0.4 ) @ 1.5  ", "imu: delayed", 1.5, None, {"delay": 0.4}),
        (
            "imu: intermittent(period=1, share=0.2)@3 for 2",
            "imu: intermittent",
            3,
            2,
            {"period": 1, "share": 0.2},
        ),
        ("coil-x: open for 3", "coil-x: open", 0.0, 3.0, {}),
        ("pwm: brown-out @ 1e1", "pwm: brown-out", 10.0, None, {}),
    ],
)
def test_a_fault_is_read_with_its_time_and_parameters(
    text: str, name: str, at: float, span: float | None, parameters: dict[str, float]
) -> None:
    fault = parse(text)
    assert (fault.kind.name, fault.at, fault.span, dict(fault.parameters)) == (name, at, span, parameters)
    assert parse(str(fault)) == fault, "the text of a fault parses to the same fault"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("imu: silnt @ 3", "did you mean 'imu: silent'"),
        ("coil-q: open", "did you mean 'coil-"),
        ("imu silent", "write it as DEVICE: KIND"),
        ("imu: silent @ soon", "'soon' is not a number"),
        ("imu: silent @ -3", "cannot be below zero"),
        ("imu: silent @ nan", "'nan' is not a number"),
        ("imu: bits (chanc=0.1)", "`imu: bits` takes chance=VALUE"),
        ("imu: bits (chance)", "`imu: bits` takes chance=VALUE"),
        ("imu: silent (delay=1)", "takes no parameters"),
        ("", "write it as"),
    ],
)
def test_a_bad_fault_is_refused_with_the_cure(text: str, complaint: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse(text)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_device_has_faults_and_every_fault_is_listed() -> None:
    devices = {kind.device for kind in CATALOGUE.values()}
    assert devices == DEVICES | {f"{part}-{axis}" for part in ("coil", "bridge") for axis in "xyz456"}
    lines = listing().splitlines()
    assert len(lines) == len(CATALOGUE)
    assert all(line.strip().startswith(name) for line, name in zip(lines, CATALOGUE, strict=True))


def test_the_list_states_random_and_optional_parameters() -> None:
    (line,) = [line for line in listing().splitlines() if line.strip().startswith("pwm: upset")]
    assert "(register=random, bit=random)" in line
    assert "register one of 0, 1, 6 to 69, 254;" in line
    with pytest.raises(UsageError, match="one of 0, 5"):
        parse("monitor: upset (register=1)")
    assert parse("imu: upset (register=75) @ 3").parameters == {"register": 75.0}


def test_a_configuration_holds_faults_as_data() -> None:
    text = TEXT.replace("  seed: 1\n", "  seed: 1\n  faults: [{fault: 'imu: silent', at: 120, for: 5}]\n")
    section = configuration.simulation_section(text, CONFIG.name, Simulation)
    assert section is not None
    (fault,) = schedule(section.faults)
    assert (fault.kind.name, fault.at, fault.span) == ("imu: silent", 120.0, 5.0)


def test_a_wrong_fault_in_a_configuration_is_reported_with_its_place() -> None:
    bad = (FaultEntry(fault="imu: silent"), FaultEntry(fault="imu: quiet"))
    with pytest.raises(UsageError, match=r"simulation\.faults\[1\].*'imu: quiet'"):
        schedule(bad)
    with pytest.raises(UsageError, match="`for` is given twice"):
        schedule((FaultEntry(fault="imu: silent for 3", span=2.0),))
    text = TEXT.replace("  seed: 1\n", "  seed: 1\n  faults: [{fault: 'imu: silent', att: 120}]\n")
    with pytest.raises(ConfigError, match="att"):
        configuration.simulation_section(text, CONFIG.name, Simulation)


def test_faults_that_need_real_time_are_refused_in_lock_step() -> None:
    killed = entries(["process: killed @ 3"])
    with pytest.raises(UsageError, match="--realtime"):
        scheduled(killed, realtime=False)
    assert scheduled(killed, realtime=True)[0].at == 3.0
    with pytest.raises(UsageError, match="corrupts the configuration file"):
        scheduled((FaultEntry(fault="config: corrupted"),), realtime=True)


@pytest.mark.parametrize("fault", ["imu: silnt", "config: corrupted (bytes=400)"])
def test_the_command_line_ends_with_one_line_and_status_2(
    fault: str, tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(CONFIG), "--out", f"{tmp_path}/run", "--fault", fault]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith("knightcube: ")
    assert errors.count("\n") == 1


def test_help_lists_every_fault(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in CATALOGUE)


PARAMETERS = [(kind, name) for kind in CATALOGUE.values() for name in kind.parameters]


@pytest.mark.parametrize(("kind", "name"), PARAMETERS, ids=lambda one: getattr(one, "name", one))
def test_each_parameter_is_held_to_its_bounds(kind: FaultKind, name: str) -> None:
    parameter = kind.parameters[name]
    beyond = (parameter.high - parameter.low) * 1e-3
    taken = parameter.choices or (parameter.low, parameter.high)
    for value in taken:
        assert parse(f"{kind.name} ({name}={value!r})").parameters[name] == value
    refused = [parameter.low - beyond, parameter.high + beyond, -1e300, 1e300]
    if parameter.whole:
        refused.append(parameter.low + 0.5)
    for wrong in refused:
        with pytest.raises(UsageError) as caught:
            parse(f"{kind.name} ({name}={wrong!r})")
        assert f"{name}={wrong!r}" in str(caught.value)
        assert parameter.bounds() in str(caught.value)
    for word in ("nan", "inf", "-inf", "", "1e999"):
        with pytest.raises(UsageError, match="is not a number"):
            parse(f"{kind.name} ({name}={word})")


@pytest.mark.parametrize(
    "text",
    [
        "imu: intermittent (period=0)",
        "coil-y: shorted (ohm=0)",
        "imu: baud (rate=-5)",
        "imu: bits (chance=7)",
        "imu: slow (n=0)",
        "pwm: delayed (delay=-1)",
        "disk: full for 0",
        "imu: silent @ 1e300",
        "imu: silent for 1e300",
    ],
)
def test_values_that_once_caused_a_hang_or_a_crash_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse(text)
    assert "\n" not in str(caught.value)
    assert text.partition("(")[2].rstrip(")") in str(caught.value)


def test_excessive_times_are_refused_in_a_section_too() -> None:
    with pytest.raises(UsageError, match=r"simulation\.faults\[0\].*give at most"):
        schedule((FaultEntry(fault="imu: silent", at=1e300),))


@pytest.mark.parametrize("kind", CATALOGUE.values(), ids=lambda kind: kind.name)
def test_every_default_is_within_its_bounds(kind: FaultKind) -> None:
    for parameter in kind.parameters.values():
        assert parameter.default is None or parameter.accepts(parameter.default)
    assert parse(kind.name).parameters.keys() <= kind.parameters.keys()


def checked(*texts: str, **changed: object) -> None:
    config = configuration.replace(demo_config(10.0), **changed)
    check(tuple(FaultEntry(fault=text) for text in texts), config, realtime=False)


@pytest.mark.parametrize(
    ("text", "changed", "cure"),
    [
        ("imu: silent @ 10", {}, "--duration"),
        ("disk: full @ 500 for 2", {}, "ends at 10 s"),
        ("camera: black", {"camera": None}, "`camera` section"),
        ("vision: nan", {"camera": None}, "`camera` section"),
        ("monitor: stuck", {"power_monitor": None}, "`power_monitor` section"),
        ("gps: silent", {}, "`gps` section"),
        ("battery-monitor: off", {}, "`power` section"),
        ("strings: dead", {}, "`solar_strings` section"),
        ("wide: blinded", {}, "`wide_cameras` section"),
        ("imu: baud (rate=115200)", {}, "another rate"),
    ],
)
def test_a_fault_that_could_do_nothing_is_refused_with_the_cure(
    text: str, changed: dict[str, object], cure: str
) -> None:
    with pytest.raises(UsageError, match=cure) as caught:
        checked(text, **changed)
    assert text.partition(" (")[0].partition(" @")[0] in str(caught.value)


@pytest.mark.parametrize(
    ("fault", "monitors", "complaint"),
    [
        (
            "battery-monitor: off",
            "battery_monitor: {driver: 'ina226:INA226', address: 0x46}",
            "not on 'ina226:INA226'",
        ),
        ("bus-monitor: off", "bus_monitor: null", "needs a `power.bus_monitor` section"),
    ],
)
def test_a_fault_of_a_power_monitor_that_is_missing_or_foreign_is_refused(
    fault: str, monitors: str, complaint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(CONFIG.parents[1] / "docs" / "examples"))
    config = configuration.parse(f"extends: orbit\npower: {{battery: {{capacity: 2.0}}, {monitors}}}\n")
    with pytest.raises(UsageError, match=complaint):
        check((FaultEntry(fault=fault),), config, realtime=False)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("camera: black @ 1 for 3", "camera: frozen @ 2"),
        ("imu: stuck", "imu: wrong @ 5"),
        ("coil-x: open @ 2", "bridge-x: a-high @ 4 for 1"),
        ("pwm: off @ 2 for 2", "pwm: stuck @ 3"),
        ("imu: reset @ 3", "imu: off @ 2 for 2"),
        ("disk: full @ 1", "disk: full @ 1"),
    ],
)
def test_a_fault_that_would_take_the_place_of_another_is_refused(first: str, second: str) -> None:
    for pair in ((first, second), (second, first)):
        with pytest.raises(UsageError, match=r"would replace .*let one end \(`for`\)"):
            checked(*pair)


def test_faults_that_follow_or_add_to_each_other_are_flown() -> None:
    checked("camera: black @ 1 for 3", "camera: frozen @ 4")
    checked("imu: bits @ 1 for 3", "imu: delayed @ 2", "imu: stuck @ 2", "imu: silent @ 3")
    checked("coil-x: open @ 2", "coil-y: open @ 2", "bus: hang @ 1", "pwm: nack @ 1", "pwm: off @ 1")


def test_the_closing_text_names_the_faults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", str(CONFIG), "--duration", "0.5", "--fault"]
    assert main([*words, "imu: silent @ 0.2 for 0.1", "--out", str(tmp_path / "one")]) == 0
    assert "\ninjected: imu: silent @ 0.2 for 0.1\n" in capsys.readouterr().out
    assert main([*words, "imu: silent @ 3", "--out", str(tmp_path / "two")]) == 2
    assert "ends at 0.5 s" in capsys.readouterr().err


def test_a_coil_that_is_not_fitted_has_no_faults() -> None:
    with pytest.raises(UsageError, match="this flight has no coil-4: the configuration has 3 coils"):
        checked("coil-4: open @ 2")
    with pytest.raises(UsageError, match="this flight has no bridge-6: the configuration has 3 coils"):
        checked("bridge-6: a-high @ 2")
