"""Tests that the check of real devices closes each opened device, whether or not the device responds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest

from flight.app import devices
from hal.interfaces.errors import NotResponding


@pytest.mark.parametrize("answers", [True, False])
def test_sensors_that_were_opened_to_be_checked_are_closed(
    answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the check did not close the sensors, the driver's thread would continue to read them."""
    unit = Mock()
    unit.configure.side_effect = None if answers else NotResponding("lis3mdl", "no acknowledge")
    monkeypatch.setattr(devices, "open_sensors", lambda *_: unit)
    section = cast(Any, SimpleNamespace(sensors=[SimpleNamespace(part="lis3mdl")]))
    if answers:
        assert "lis3mdl" in devices.probe_sensors(Mock(), section)
    else:
        with pytest.raises(NotResponding):
            devices.probe_sensors(Mock(), section)
    unit.close.assert_called_once_with()
