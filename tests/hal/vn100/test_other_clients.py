"""Tests that unchanged independent clients work with the emulated VN-100 over a pseudo-terminal."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

vectornav = pytest.importorskip("vectornav", reason="vectornav-vn200, another's client, is not installed")


@pytest.fixture
def client() -> Iterator[Any]:
    """Yield a polling VectorNav client that is connected to a VN-100 at rest."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sim_hal", "emulate", "vn100", "--rate-deg-s", "0", "--json"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        with vectornav.VN200(json.loads(process.stdout.readline())["device"]) as unit:
            yield unit
    finally:
        process.terminate()
        process.communicate(timeout=5)


def test_a_polling_client_reads_tares_and_is_refused_like_on_a_real_unit(client: Any) -> None:
    assert client.read_model_number().startswith("VN-100")
    accelerations = client.read_ypr_body_accel_gyro()  # the client reads register 239
    assert len(accelerations) == 9
    assert math.hypot(*client.read_accel().values()) == pytest.approx(9.81, abs=0.1)
    assert math.hypot(*client.read_mag().values()) == pytest.approx(4.5, rel=0.05)
    assert client._send_command("VNTAR") == "VNTAR"
    assert client.read_yaw() == pytest.approx(0.0, abs=1.0)
    assert client._send_command("VNSIH,+090.000") == "VNSIH,+090.000"
    assert client.read_yaw() == pytest.approx(90.0, abs=1.0)
    assert client._read_register(36) == ["4"] * 3 + ["5"] * 3 + ["5.5"] * 3
    with pytest.raises(vectornav.VN200Error, match="Invalid Register"):
        client.read_gps()
    with pytest.raises(vectornav.VN200Error, match="Unauthorized"):
        client._send_command("VNWRG,239,0,0,0,0,0,0,0,0,0")
