"""The devices of an orbit in a process of their own, in real time: terminal, socket, frames, faults."""

from __future__ import annotations

import re
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from flight.app.devices import open_gps, open_strings
from flight.schema import reader
from hal.interfaces.devices import Frame, GpsReading
from hal.interfaces.wires import SECOND_NS, Rig
from sim_hal.serving import remote

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
    flown = re.sub(r"\nwide_cameras:.*?\n\n", "\n\n", flown, flags=re.DOTALL)  # smaller ones follow
    path.write_text(flown.replace("\ngps: {}", "\n") + DEVICES, encoding="utf-8")
    config = reader.load(path)
    fixes: list[GpsReading] = []
    frames: dict[int, Frame] = {}
    with ExitStack() as stack:
        served = stack.enter_context(remote.served(path, 1, tmp_path))
        rig = Rig(served.clock, served.wires, served.release, True, 1)
        gps, strings = open_gps(config, rig, stack), open_strings(config, rig, stack)
        assert gps is not None
        assert strings is not None
        served.release(served.clock.now_ns(), ["gps: no-fix @ 1.5", "wide: black (camera=2) @ 0"])
        for camera in served.wires.wide:
            camera.trigger(SECOND_NS // 200)
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and not (
            len(frames) == 2 and strings.latest() is not None and fixes and not fixes[-1].valid
        ):
            fixes += gps.poll()
            for number, camera in enumerate(served.wires.wide):
                frame = camera.poll()
                if frame is not None:
                    frames[number] = frame
            time.sleep(0.02)
        reading = strings.latest()
    assert fixes[0].valid
    assert not fixes[-1].valid
    assert frames[0].pixels.shape == (128, 128)
    assert frames[0].pixels.any()
    assert not frames[1].pixels.any()
    assert reading is not None
    assert np.all(reading.currents < 1.0)
