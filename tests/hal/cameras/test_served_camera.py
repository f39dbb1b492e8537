"""Tests of a camera that a separate process serves: the loop never waits, and frame numbers increase."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from hal.buses.system import SystemClock
from hal.drivers.camera import CameraCounts, FrameNumbers, ServedCamera
from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding, OutOfRange

WAIT_S = 5.0


class SlowCamera:
    """A camera whose exposures hang until they are released."""

    def __init__(self) -> None:
        self.name = "slow"
        self.counts = CameraCounts()
        self.begun = threading.Event()
        self.go = threading.Event()
        self._frame: Frame | None = None

    def open(self) -> None:
        pass

    def check(self, exposure_ns: int) -> None:
        if exposure_ns < 0:
            raise OutOfRange(self.name, "exposure", exposure_ns * 1e-9, 0.0, 1.0, "s")

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        self.begun.set()
        assert self.go.wait(WAIT_S)
        self._frame = Frame(1, trigger_ns, exposure_ns, trigger_ns + exposure_ns, np.zeros((4, 4), np.uint8))

    def collect(self) -> Frame | None:
        frame, self._frame = self._frame, None
        return frame

    def close(self) -> None:
        pass


def test_neither_trigger_nor_poll_waits_for_a_camera_that_hangs() -> None:
    device, clock = SlowCamera(), SystemClock()
    camera = ServedCamera(device, clock)
    camera.trigger(1_000_000)
    assert device.begun.wait(WAIT_S)
    # The job now waits inside the camera. If the job held a lock, the following calls would block forever.
    camera.trigger(2_000_000)
    assert camera.poll() is None
    device.go.set()
    deadline_ns = clock.now_ns() + round(WAIT_S * 1e9)
    while (frame := camera.poll()) is None and clock.now_ns() < deadline_ns:
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
    assert frame is not None
    assert frame.exposure_ns == 2_000_000
    assert camera.counts.delivered == 1, "the first was abandoned"
    camera.close()


def test_a_closed_camera_answers_nothing() -> None:
    camera = ServedCamera(SlowCamera(), SystemClock())
    camera.close()
    with pytest.raises(NotResponding, match="was closed"):
        camera.trigger(1)
    with pytest.raises(NotResponding, match="was closed"):
        camera.poll()


@pytest.mark.parametrize(
    ("counts", "numbers"),
    [
        ([5, 6, 9], [5, 6, 9]),
        ([98, 99, 0, 1], [98, 99, 100, 101]),
        ([7, 7, 7], [7, 7, 7]),
        ([7, 5, 8], [7, 5, 8]),
        ([99, 0, 99, 0], [99, 100, 199, 200]),
    ],
)
def test_frame_numbers_go_on_where_the_count_wraps(counts: list[int], numbers: list[int]) -> None:
    frames = FrameNumbers(100)
    assert [frames.number(count) for count in counts] == numbers


def test_frame_numbers_go_on_where_the_camera_begins_again() -> None:
    frames = FrameNumbers(100)
    first = [frames.number(count) for count in (0, 1, 2)]
    frames.begin_again()
    assert first + [frames.number(count) for count in (0, 1)] == [0, 1, 2, 3, 4]
