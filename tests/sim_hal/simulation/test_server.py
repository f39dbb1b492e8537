"""The server of emulated devices: light to start, and its renderer makes no frame that nobody will see."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import Future
from typing import Any

import numpy as np

from sim_hal.serving.server import DeviceServer


class IdlePool:
    """A pool whose process is busy: submitted jobs wait."""

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


def test_a_server_starts_without_the_optics_that_its_renderer_needs() -> None:
    code = "import sys, sim_hal.serving.cli; sys.stdout.write(str('sim_hal.star_camera' in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "False"
