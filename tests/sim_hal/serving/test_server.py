"""Tests of the device server: its start, its rendering process, and devices in orbit in real time."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock, call

import numpy as np
import pytest

from flight.app.devices import opened as opened_device
from flight.schema import reader
from hal.interfaces.devices import Frame, GpsReading
from hal.interfaces.wires import SECOND_NS, Rig
from sim_hal import __main__
from sim_hal.rig import started_server
from sim_hal.serving.server import DeviceServer


class IdlePool:
    """A process pool whose process is busy, so submitted jobs wait."""

    def submit(self, *_: Any) -> Future[Any]:
        return Future()


def test_a_frame_that_waits_to_be_rendered_is_given_up_for_the_next() -> None:
    server = DeviceServer.__new__(DeviceServer)
    server.__dict__.update(_pool=IdlePool(), _rendering=None)
    times, attitudes = np.zeros(1), np.zeros((1, 4))
    first = server._expose(1, times, attitudes, ())
    second = server._expose(2, times, attitudes, ())
    assert first.cancelled()
    assert not second.cancelled()


def test_a_frame_that_cannot_be_written_is_lost_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = Frame(4, 5, 6, 7, np.ones((2, 3), np.uint16))
    client = Mock(wants_frames={0})
    server = DeviceServer.__new__(DeviceServer)
    server.hardware = Mock(camera=Mock(poll=lambda: frame), orbit=Mock(wide=()))
    server.__dict__.update(_frames_sent=0, _connections={1: client}, socket_path=tmp_path / "devices")
    (tmp_path / "frame-0-0.raw").mkdir()
    server._deliver_frames()
    assert re.fullmatch(
        "sim_hal: a frame is lost: .*frame-0-0.raw: Is a directory.*\n", capsys.readouterr().err
    )
    client.answer.assert_not_called()
    server._deliver_frames()
    assert client.answer.call_args.args[0][-1] == "frame-0-1.raw"
    assert (tmp_path / "frame-0-1.raw").read_bytes() == frame.pixels.tobytes()


def test_a_server_starts_without_the_optics_that_its_renderer_needs() -> None:
    code = "import sys, sim_hal.__main__; sys.stdout.write(str('sim_hal.star_camera' in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "False"


DEVICES = """
gps: {period: 0.2}
wide_cameras:
  - {columns: 128, rows: 128}
  - {columns: 128, rows: 128, mounting: [1, 0, 0, 0]}
"""
PATIENCE_S = 15.0


def test_receiver_strings_and_wide_cameras_answer_in_real_time_with_their_faults(tmp_path: Path) -> None:
    path = tmp_path / "orbit.yaml"
    flown = Path("config/orbit.yaml").read_text(encoding="utf-8")
    # The horizon cameras are replaced by cameras with fewer pixels.
    flown = re.sub(r"\nwide_cameras:.*?\n\n", "\n\n", flown, flags=re.DOTALL)
    path.write_text(flown.replace("\ngps: {}", "\n") + DEVICES, encoding="utf-8")
    config = reader.load(path)
    fixes: list[GpsReading] = []
    frames: dict[int, Frame] = {}
    with ExitStack() as stack:
        served = stack.enter_context(started_server(path, 1, tmp_path))
        rig = Rig(served.clock, served.wires, served.release, True, 1)
        gps, strings = (opened_device(kind, config, rig, stack) for kind in ("gps", "solar_strings"))
        assert gps is not None
        assert strings is not None
        served.release(served.clock.now_ns(), ["gps: no-fix @ 1.5", "wide: black (camera=2) @ 0"])
        wide = [camera for camera in served.cameras[1:] if camera is not None]
        for camera in wide:
            camera.trigger(SECOND_NS // 200)
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and not (
            len(frames) == 2 and strings.latest() is not None and fixes and not fixes[-1].valid
        ):
            fixes += gps.poll()
            for number, camera in enumerate(wide):
                frame = camera.poll()
                if frame is not None:
                    frames[number] = frame
            time.sleep(0.02)
        reading = strings.latest()
        host_ns = served.clock.utc_ns() - (served.clock.now_ns() - fixes[0].time_ns)
    assert fixes[0].valid
    assert abs(host_ns - fixes[0].utc_ns) < PATIENCE_S * SECOND_NS, "the host has the simulated UTC too"
    assert not fixes[-1].valid
    assert frames[0].pixels.shape == (128, 128)
    assert frames[0].pixels.any()
    assert not frames[1].pixels.any()
    assert reading is not None
    assert np.all(reading.currents < 1.0)


@pytest.mark.parametrize("patience", [None, 2.5])
def test_the_facts_are_written_before_the_devices_are_served(
    patience: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The facts are written and flushed before the devices are served.

    The parent process waits for the line with the facts.
    """
    calls = Mock()
    calls.server.lines = {"/dev/knightcube-imu": "/dev/pts/7"}
    calls.server.socket_path = tmp_path / "devices"
    calls.server.hardware.utc_offset_ns = 5
    made: list[Any] = []

    def served(*words: Any) -> Mock:
        made.append(words)
        return cast(Mock, calls.server)

    monkeypatch.setattr(__main__, "DeviceServer", served)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "stdout", calls.stdout)
    words = [
        "serve",
        "config/step_demo.yaml",
        "--folder",
        str(tmp_path),
        "--facts",
        str(tmp_path / "facts"),
        "--seed",
        "9",
    ]
    calls.server.serve.side_effect = RuntimeError
    with pytest.raises(RuntimeError):
        __main__.main([*words, *([] if patience is None else ["--patience", str(patience)])])
    (written,) = calls.stdout.write.call_args.args
    assert calls.mock_calls == [
        call.stdout.write(written),
        call.stdout.flush(),
        call.server.serve(None if patience is None else 2_500_000_000),
        call.server.close(),
    ]
    facts = json.loads(written)
    assert json.loads((tmp_path / "facts").read_text(encoding="utf-8")) == facts
    assert (facts["lines"], facts["camera"], facts["wide"]) == (calls.server.lines, True, 0)
    ((config, section, folder),) = made
    assert (section.seed, folder) == (9, tmp_path)
    assert facts["coil_bus"] == f"/dev/i2c-{config.coils.bus}"
