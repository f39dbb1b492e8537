"""Tests that the code on the page "Add a device" makes a working driver, which is then used in a run."""

from __future__ import annotations

import csv
import inspect
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from flight.__main__ import main
from flight.schema import reader
from flight.schema.devices import Driver, UnitSection, later
from flight.schema.document import MODULES, ConfigError
from ground.telemetry import read_run
from hal.interfaces import devices, wires
from tests.docs.blocks import ROOT, blocks_of

PAGE = (ROOT / "docs" / "extending" / "device.md").read_text(encoding="utf-8")
EXAMPLES = ROOT / "docs" / "examples"


def snippet(name: str) -> str:
    """Return the text that the page includes: a file, or a marked section of a file."""
    path, _, part = name.partition(":")
    text = (ROOT / "docs" / path).read_text(encoding="utf-8")
    if not part:
        return text
    begin, end = (f"# --8<-- [{word}:{part}]\n" for word in ("start", "end"))
    return text.partition(begin)[2].partition(end)[0]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with the files that a reader of the page writes."""
    blocks = [block for block in blocks_of(PAGE) if "--8<--" in block.text and "ina226" in block.text]
    shown = {language: "" for language in ("python", "yaml")}
    for block in blocks:
        shown[block.language] += "".join(snippet(name) for name in re.findall(r'--8<-- "(.+)"', block.text))
    (tmp_path / "ina226.py").write_text(shown["python"], encoding="utf-8")
    (tmp_path / "ina226.yaml").write_text(shown["yaml"], encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "ina226", raising=False)
    return tmp_path


def run_commands(name: str) -> None:
    """Run the commands of the page that contain a file name."""
    (block,) = (block for block in blocks_of(PAGE) if block.mark == "run by" and name in block.text)
    first, *commands = block.commands
    assert first == "export PYTHONPATH=."
    for line in commands:
        program, *words = line.split()
        assert program == "knightcube"
        assert main(words) == 0, line


def test_a_sensor_of_the_page_flies_by_the_commands_of_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("qmc5883.py", "qmc5883.yaml"):
        (tmp_path / name).write_text(snippet(f"examples/{name}"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "qmc5883", raising=False)
    run_commands("qmc5883")
    imu = read_run(tmp_path / "run")["imu"]
    sizes = np.linalg.norm(imu["field"], axis=1)
    assert len(imu) == pytest.approx(5 * 40, abs=3)
    assert 1.5e-5 < sizes.min() < 7e-5, "T, in low Earth orbit while the coils rest"
    assert np.std(np.diff(imu["field"][:, 0])[:3]) > 1e-9, "each reading is new"


def test_the_interfaces_of_the_page_are_those_of_the_code() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (`\w+\(.*\)`) \|(.*)\|$", PAGE, re.MULTILINE)
    assert {"SerialPort", "InertialUnit"} <= {name for name, _, _ in rows}
    for interface, methods, results in rows:
        kind = getattr(wires if interface == "SerialPort" else devices, interface)
        for name, parameters in re.findall(r"`(\w+)\(([^`]*)\)`", methods):
            assert [*inspect.signature(getattr(kind, name)).parameters] == ["self", *_words(parameters)], name
        assert {name for name in vars(kind) if not name.startswith("_")} == set(
            re.findall(r"`(\w+)\(", methods)
        ), interface
        for name, parameters in re.findall(r"`([A-Z]\w+)\(([^`]*)\)`", results):
            assert [*inspect.signature(getattr(devices, name)).parameters] == _words(parameters), name


class _Gyro(UnitSection, frozen=True, kw_only=True):
    """Section of a unit on a serial line, whose driver is registered without a function for its files."""

    device: str = "/dev/ttyS7"


def test_a_device_file_in_the_key_device_is_registered_without_a_function() -> None:
    function = later("module:function")
    named = Driver("inertial_unit", _Gyro, function, function)
    assert [*named.files(_Gyro(device="/dev/ttyS3"))] == ["/dev/ttyS3"]
    without = Driver("inertial_unit", UnitSection, function, function)
    assert [*without.files(UnitSection())] == [], "it has no such key"


def _words(text: str) -> list[str]:
    return re.findall(r"\w+", text)


def test_the_driver_of_the_page_flies_by_the_commands_of_the_page(folder: Path) -> None:
    run_commands("ina226")
    with (folder / "run" / "csv" / "housekeeping.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [round(float(row["coil_voltage"]), 2) for row in rows[1:]] == [5.0] * 4
    assert max(float(row["coil_current"]) for row in rows[1:]) > 0.01, "the coils draw current"


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("averages: 64", "averages: many", r"ina226.yaml:6: `power_monitor.averages` is 'many'"),
        ("averages: 64", "average: 64", "is an unknown key, did you mean `averages`"),
        ("address: 0x44", "address: 0x50", r"is 0x50 \(80\), but .* has 0x40 to 0x4f"),
        ("ina226:INA226", "ina226:INA227", "cannot be imported"),
        ("ina226:INA226", "ina226:Ina226", "not a Driver"),
    ],
)
def test_a_mistake_in_the_section_is_named_with_its_line(
    folder: Path, old: str, new: str, complaint: str
) -> None:
    text = (folder / "ina226.yaml").read_text(encoding="utf-8").replace(old, new)
    with pytest.raises(ConfigError, match=complaint):
        reader.parse(text, "ina226.yaml")


def test_a_value_that_the_device_does_not_accept_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "ina226.yaml"
    path.write_text(
        path.read_text(encoding="utf-8").replace("averages: 64", "averages: 65"), encoding="utf-8"
    )
    assert main(["check", "ina226.yaml"]) == 2
    assert "`power_monitor.averages` is 65: must be 1 to 1024" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "problem", "status"),
    [
        (
            "return Ina226(rig.wires",
            "return Ina226(rig.wire",
            "`open_monitor` failed: LINE: Attr",
            1,
        ),
        ("return Ina226(rig.wires", "Ina226(rig.wires", "`open` returns None: return the device", 1),
        ("def error(self)", "def errors(self)", "driver Ina226 has no method `error`: add it", 1),
        ("if section.averages not", "if section.average not", "`check` failed: LINE: Attr", 2),
        (
            "i2c(section.bus).attach(chip)",
            "i2c(section.bus).atach(chip)",
            "`emulate` failed: LINE: Attr",
            2,
        ),
    ],
)
def test_a_mistake_in_the_code_of_a_driver_is_named_with_its_line(
    folder: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, problem: str, status: int
) -> None:
    """Errors of `open` have status 1, because a transient fault of a device must not end a service."""
    text = (folder / "ina226.py").read_text(encoding="utf-8")
    assert old in text
    (folder / "ina226.py").write_text(text.replace(old, new), encoding="utf-8")
    assert main(["run", "ina226.yaml", "--out", "run"]) == status
    error, problem = capsys.readouterr().err, problem.replace("LINE", r".*ina226\.py:\d+")
    assert re.search(f"`power_monitor.driver`:? is 'ina226:INA226', whose (function )?{problem}", error), (
        error
    )


@pytest.mark.parametrize("clock", ["lock-step", "real time"])
def test_a_mistake_in_the_code_of_an_emulator_ends_the_simulation_and_is_named_with_its_line(
    folder: Path, capfd: pytest.CaptureFixture[str], clock: str
) -> None:
    """The mistake occurs in flight, when the driver reads a register. A traceback is not printed."""
    text = (folder / "ina226.py").read_text(encoding="utf-8")
    assert "volts / BUS_STEP_V)" in text
    (folder / "ina226.py").write_text(text.replace("volts / BUS_STEP_V)", "volts / BUS)()"), encoding="utf-8")
    words = ["run", "ina226.yaml", "--out", "run", *(["--realtime"] if clock == "real time" else [])]
    assert main(words) == (1 if clock == "real time" else 2)
    error = capfd.readouterr().err
    named = r"the emulator ina226:EmulatedIna226 failed: .*ina226\.py:\d+: TypeError: .*: correct this line"
    assert re.search(named, error), error
    assert "Traceback" not in error
    assert clock == "lock-step" or "knightcube: emulated devices: the server ended during the flight" in error


def test_a_board_imports_the_driver_only_if_root_permits_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = folder / "modules"
    listed.write_text("", encoding="utf-8")
    monkeypatch.setenv(MODULES, str(listed))
    with pytest.raises(ConfigError, match="add it as a line to"):
        reader.load(folder / "ina226.yaml")
    assert "ina226" not in sys.modules
    if os.getuid() == 0:
        listed.write_text("ina226:INA226\n", encoding="utf-8")
        assert reader.load(folder / "ina226.yaml").power_monitor is not None
