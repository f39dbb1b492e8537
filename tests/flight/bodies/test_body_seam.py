"""Tests of the interface of bodies: the names that a configuration may give, and the reports of a body."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from flight.app.flight import body_kind
from flight.loop.flight_loop import ATTITUDE_EVERY
from flight.schema import reader
from flight.schema.bodies import as_testbed
from flight.schema.document import ConfigError
from ground.telemetry import Run
from knightcube.astro.quaternion import about_axis_y, angle_about_axis_y
from knightcube.gnc.guidance.plant import Q2_LIMIT
from tests.support.flights import CONFIG, demo_config, fly

DIPOLE_PER_AMPERE = 80 * 0.0081


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return fly(demo_config(8.0, camera=False), tmp_path_factory.mktemp("attitude"))


def test_the_attitude_packet_is_the_control_packet_in_three_axes(flown: Run) -> None:
    control, attitude = flown["control"][::ATTITUDE_EVERY], flown["attitude"]
    known = np.isfinite(control["angle"])
    assert known.sum() > 70
    np.testing.assert_array_equal(attitude["time_ns"], control["time_ns"])
    angles = np.array([angle_about_axis_y(q) for q in attitude["quaternion"]])
    np.testing.assert_array_equal(angles[known], control["angle"][known])
    np.testing.assert_array_equal(attitude["rate"][known, 1], control["rate"][known])
    np.testing.assert_allclose(attitude["angle_sigma"][known, 1], control["angle_sigma"][known], rtol=1e-6)
    np.testing.assert_allclose(attitude["rate_sigma"][known, 1], control["rate_sigma"][known], rtol=1e-6)
    np.testing.assert_allclose(
        attitude["dipole"], DIPOLE_PER_AMPERE * control["current_command"], rtol=1e-6, atol=1e-9
    )
    on_path = np.isfinite(control["path_q2"])
    np.testing.assert_allclose(attitude["wanted"][on_path, 1], control["path_q2"][on_path], atol=1e-12)
    np.testing.assert_array_equal(attitude["wanted_rate"][on_path, 1], control["path_rate"][on_path])
    np.testing.assert_allclose(attitude["target"][-1], about_axis_y(2.0 * np.arcsin(-0.3)), atol=1e-12)


def test_a_body_of_a_third_party_is_flown_by_its_name(tmp_path: Path) -> None:
    """The third-party PD controller holds the target in the testbed world.

    The loop contains no code for this body.
    """
    config = structs.replace(demo_config(40.0, camera=False), body="tests.flight.bodies.plain_body:PLAIN")
    run = fly(config, tmp_path)
    q2 = run["truth"]["quaternion"][:, 1]
    assert abs(q2[-1] + 0.3) < 0.02


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("orbiter", "name one of testbed"),
        ("no_such_module:BODY", "set PYTHONPATH to the folder of no_such_module.py, or install the package"),
        ("tests.flight.bodies.plain_body:MISSING", "cannot be imported"),
        ("tests.flight.bodies.plain_body:NO_BODY", "not a BodyKind"),
    ],
)
def test_a_missing_body_is_reported_in_one_line(name: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        body_kind(structs.replace(demo_config(1.0), body=name))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("\nimport strct", r":2: ModuleNotFoundError: No module named 'strct': correct this line"),
        ("def f(:", r"odd_body.py:1: invalid syntax"),
        ("\n\n1 / 0", r"odd_body.py:3: ZeroDivisionError"),
        ("Body = 1", r"has no attribute 'BODY', did you mean `odd_body:Body`"),
    ],
)
def test_an_error_inside_a_module_names_its_file_and_line(
    text: str, complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "odd_body.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "odd_body", raising=False)
    with pytest.raises(ConfigError, match=complaint):
        body_kind(structs.replace(demo_config(1.0), body="odd_body:BODY"))


@pytest.mark.parametrize("q2", [-Q2_LIMIT, Q2_LIMIT])
def test_a_step_that_the_configuration_may_ask_for_is_one_that_the_loop_accepts(
    q2: float, tmp_path: Path
) -> None:
    """The check of a configuration accepts a step of `q2` exactly if the loop accepts it."""
    text = CONFIG.read_text(encoding="utf-8")
    config = as_testbed(reader.parse(text.replace("q2: -0.3", f"q2: {q2}", 1)))
    config = structs.replace(demo_config(3.0, camera=False), steps=config.steps[:1])
    run = fly(config, tmp_path)
    assert b"task-failed" not in set(run["event"]["name"].tolist())
    with pytest.raises(ConfigError, match="q2"):
        reader.parse(text.replace("q2: -0.3", f"q2: {1.02 * q2:.4f}", 1))
