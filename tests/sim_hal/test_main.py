"""Tests of the options of `python -m sim_hal`: names, values, defaults and limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flight.schema.document import config_path
from sim_hal.__main__ import _parser, main

VN100 = {
    "rate_deg_s": None,
    "amplitude_deg": 20.0,
    "period_s": 20.0,
    "field": 4.5e-4,
    "baud": 115200,
    "noise": "thesis",
    "seed": 1,
    "link": None,
    "duration": None,
    "json": False,
}
I2C = {
    "config": config_path("step_demo"),
    "program": [],
    "bus": 1,
    "seed": 1,
    "duration": None,
    "json": False,
}
SERVE = {
    "config": config_path("testbed"),
    "folder": Path("run"),
    "seed": None,
    "patience": None,
    "facts": None,
}


def _values(words: str) -> dict[str, Any]:
    """Return the values of a command line's options after parsing."""
    values = vars(_parser().parse_args(words.split()))
    del values["command"]
    return values


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        ("", {}),
        (
            "--rate-deg-s -3.5 --amplitude-deg 0 --period-s 4",
            {"rate_deg_s": -3.5, "amplitude_deg": 0.0, "period_s": 4.0},
        ),
        ("--field 3e-5 --baud 9600 --seed 0", {"field": 3e-5, "baud": 9600, "seed": 0}),
        (
            "--link imu --duration 0.5 --json --noise datasheet",
            {"link": Path("imu"), "duration": 0.5, "json": True, "noise": "datasheet"},
        ),
    ],
)
def test_the_options_of_an_emulated_unit(words: str, changes: dict[str, Any]) -> None:
    assert _values(f"emulate vn100 {words}") == {**VN100, **changes}


def test_the_options_of_the_emulated_bus() -> None:
    assert _values("emulate i2c") == I2C
    given = _values("emulate i2c --config testbed --bus 7 --seed 3 --duration 2 --json -- ls -l")
    assert given == {
        "config": config_path("testbed"),
        "program": ["ls", "-l"],
        "bus": 7,
        "seed": 3,
        "duration": 2.0,
        "json": True,
    }


def test_the_options_of_the_device_server() -> None:
    assert _values("serve testbed --folder run") == SERVE
    given = _values("serve testbed --folder run --seed 4 --patience 1.5 --facts f.json")
    assert given == {**SERVE, "seed": 4, "patience": 1.5, "facts": Path("f.json")}


@pytest.mark.parametrize(
    "words",
    [
        "",
        "emulate",
        "serve testbed",
        "emulate vn100 --seed -1",
        "emulate vn100 --period-s 0",
        "emulate vn100 --duration -1",
        "emulate vn100 --field nan",
        "emulate vn100 --baud 1234",
        "emulate i2c --bus 256",
        "emulate i2c --duration inf",
    ],
)
def test_wrong_options_end_with_status_2(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    assert "error: " in capsys.readouterr().err
