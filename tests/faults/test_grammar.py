"""Faults are read as they are written, and a bad one is refused with the nearest right name."""

from __future__ import annotations

import pytest

from flight import config as configuration
from flight.cli import main
from flight.errors import ConfigError, UsageError
from sim_hal.faults.catalogue import CATALOGUE, listing
from sim_hal.faults.grammar import entries, parse, schedule
from sim_hal.faults.schedule import scheduled
from sim_hal.settings import FaultEntry, Simulation
from tests.scenario.flights import CONFIG, TEXT

DEVICES = {
    "imu",
    "pwm",
    "monitor",
    "bus",
    "camera",
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
    assert parse(str(fault)) == fault, "what is written down is read as the same"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("imu: silnt @ 3", "did you mean 'imu: silent'"),
        ("coil-q: open", "did you mean 'coil-"),
        ("imu silent", "write it as DEVICE: KIND"),
        ("imu: silent @ soon", "'soon' is no number"),
        ("imu: silent @ -3", "cannot be below zero"),
        ("imu: silent @ nan", "'nan' is no number"),
        ("imu: bits (chanc=0.1)", "imu: bits has chance"),
        ("imu: bits (chance)", "imu: bits has chance"),
        ("imu: silent (delay=1)", "has no parameters"),
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
    assert devices == DEVICES | {f"{part}-{axis}" for part in ("coil", "bridge") for axis in "xyz"}
    lines = listing().splitlines()
    assert len(lines) == len(CATALOGUE)
    assert all(line.strip().startswith(name) for line, name in zip(lines, CATALOGUE, strict=True))


def test_a_configuration_holds_faults_as_data() -> None:
    text = TEXT.replace("  seed: 1\n", "  seed: 1\n  faults: [{fault: 'imu: silent', at: 120, for: 5}]\n")
    section = configuration.simulation_section(text, CONFIG.name, Simulation)
    assert section is not None
    (fault,) = schedule(section.faults)
    assert (fault.kind.name, fault.at, fault.span) == ("imu: silent", 120.0, 5.0)


def test_a_fault_in_a_configuration_is_complained_of_with_its_place() -> None:
    bad = (FaultEntry(fault="imu: silent"), FaultEntry(fault="imu: quiet"))
    with pytest.raises(UsageError, match=r"simulation\.faults\[1\].*'imu: quiet'"):
        schedule(bad)
    with pytest.raises(UsageError, match="`for` stands twice"):
        schedule((FaultEntry(fault="imu: silent for 3", span=2.0),))
    text = TEXT.replace("  seed: 1\n", "  seed: 1\n  faults: [{fault: 'imu: silent', att: 120}]\n")
    with pytest.raises(ConfigError, match="att"):
        configuration.simulation_section(text, CONFIG.name, Simulation)


def test_what_makes_sense_in_real_time_only_is_refused_in_lock_step() -> None:
    killed = entries(["process: killed @ 3"])
    with pytest.raises(UsageError, match="--realtime"):
        scheduled(killed, realtime=False)
    assert scheduled(killed, realtime=True)[0].at == 3.0
    with pytest.raises(UsageError, match="cannot corrupt itself"):
        scheduled((FaultEntry(fault="config: corrupted"),), realtime=True)


@pytest.mark.parametrize("fault", ["imu: silnt", "config: corrupted (bytes=400)"])
def test_the_command_line_ends_with_one_line_and_status_2(
    fault: str, tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(CONFIG), "--out", f"{tmp_path}/run", "--fault", fault]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith("flight: ")
    assert errors.count("\n") == 1


def test_help_lists_every_fault(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in CATALOGUE)
