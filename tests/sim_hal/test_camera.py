"""Tests of the emulated camera: triggers, readout, and each fault on frames with known pixels."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future

import numpy as np
import pytest

from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import IDENTITY
from sim_hal.clock import NEVER
from sim_hal.emulators.camera import SPOILT, EmulatedCamera
from sim_hal.worlds.world import BodyMotion, about_thread

MS = 1_000_000
EXPOSURE_NS, READOUT_NS, SCAN_NS = 100 * MS, 50 * MS, 20 * MS


class Bench:
    """A camera on a manual clock. Frame n has the count n in its first row, and 10 n in all other rows."""

    def __init__(self) -> None:
        self.now_ns = 1000 * MS
        self.times: list[FloatArray] = []
        self.camera = EmulatedCamera(
            self._motion, self._expose, lambda: self.now_ns, READOUT_NS, IDENTITY, SCAN_NS
        )

    @staticmethod
    def _motion(time_ns: int) -> BodyMotion:
        return about_thread(time_ns, 0.1, 0.0, 1e-5)

    def _expose(
        self, sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[object]
    ) -> Future[Image]:
        assert len(times) == len(attitudes)
        assert not tracks
        self.times.append(times)
        done: Future[Image] = Future()
        done.set_result(np.array([[sequence] * 3, [10 * sequence] * 3], dtype=np.uint16))
        return done

    def frame(self) -> Frame | None:
        """Trigger a frame, and return it after its readout."""
        self.camera.trigger(EXPOSURE_NS)
        self.wait(EXPOSURE_NS + SCAN_NS + READOUT_NS)
        return self.camera.poll()

    def wait(self, span_ns: int) -> None:
        """Advance the clock."""
        self.now_ns += span_ns
        self.camera.advance(self.now_ns)


def pixels(frame: Frame | None) -> list[list[int]]:
    """Return the pixels of a frame."""
    assert frame is not None
    found: list[list[int]] = frame.pixels.tolist()
    return found


def test_a_frame_comes_once_after_exposure_scan_and_read_out() -> None:
    bench = Bench()
    begun_ns = bench.now_ns
    bench.camera.trigger(EXPOSURE_NS)
    bench.wait(EXPOSURE_NS + SCAN_NS + READOUT_NS - 1)
    assert bench.camera.poll() is None
    bench.wait(1)
    frame = bench.camera.poll()
    assert frame is not None
    assert (frame.sequence, frame.exposure_start_ns, frame.exposure_ns) == (1, begun_ns, EXPOSURE_NS)
    assert frame.arrival_ns == bench.now_ns
    assert bench.camera.poll() is None
    assert bench.camera.next_event_ns() == NEVER
    (times,) = bench.times
    assert times[0] == 0.0
    assert times[-1] == pytest.approx((EXPOSURE_NS + SCAN_NS) * 1e-9)
    assert np.all(np.diff(times) > 0.0)


def test_a_frozen_camera_repeats_number_and_pixels_at_new_times() -> None:
    bench = Bench()
    first = bench.frame()
    bench.camera.fault = "frozen"
    second, third = bench.frame(), bench.frame()
    assert first is not None
    assert second is not None
    assert pixels(second) == pixels(third) == pixels(first) == [[1, 1, 1], [10, 10, 10]]
    assert (second.sequence, second.exposure_start_ns > first.exposure_start_ns) == (1, True)
    bench.camera.fault = ""
    assert pixels(bench.frame()) == [[4, 4, 4], [40, 40, 40]]


def test_a_torn_frame_has_the_upper_half_of_the_previous_one() -> None:
    bench = Bench()
    bench.camera.fault = "torn"
    assert pixels(bench.frame()) == [[1, 1, 1], [10, 10, 10]], "there is no previous frame"
    assert pixels(bench.frame()) == [[1, 1, 1], [20, 20, 20]]
    assert pixels(bench.frame()) == [[2, 2, 2], [30, 30, 30]]


def test_a_camera_that_is_off_refuses_triggers_and_loses_its_frame() -> None:
    bench = Bench()
    bench.camera.trigger(EXPOSURE_NS)
    bench.camera.fault = "off"
    bench.wait(1000 * MS)
    assert bench.camera.poll() is None
    with pytest.raises(NotResponding):
        bench.camera.trigger(EXPOSURE_NS)


def test_a_slow_camera_obeys_one_trigger_of_n_and_a_late_one_delays_its_frame() -> None:
    bench = Bench()
    bench.camera.one_of = 3
    assert [bench.frame() is not None for _ in range(6)] == [False, False, True, False, False, True]
    bench.camera.one_of = 1
    bench.camera.late_ns = 5
    assert bench.frame() is None
    bench.wait(4)
    assert bench.camera.poll() is None
    bench.wait(1)
    assert bench.camera.poll() is not None


def test_a_trigger_abandons_the_exposure_under_way() -> None:
    bench = Bench()
    bench.camera.trigger(EXPOSURE_NS)
    bench.wait(10 * MS)
    second = bench.frame()
    assert second is not None
    assert second.sequence == 2
    bench.camera.trigger(EXPOSURE_NS)
    bench.camera.close()
    bench.wait(1000 * MS)
    assert bench.camera.poll() is None


def test_the_spoilt_frames_are_those_of_their_names() -> None:
    plain = np.arange(12, dtype=np.uint8).reshape(4, 3)
    assert not SPOILT["black"](plain, 1).any()
    assert (SPOILT["saturated"](plain, 1) == 255).all()
    np.testing.assert_array_equal(SPOILT["wrong"](plain, 1), plain[::-1])
    garbage = SPOILT["garbage"](plain, 1)
    assert not np.array_equal(garbage, SPOILT["garbage"](plain, 2))
    assert garbage.dtype == plain.dtype
    veiled = SPOILT["blinded"](np.zeros((64, 64), dtype=np.uint16), 3)
    assert veiled.max() == 65535
    assert veiled.min() == pytest.approx(0.1 * 65535, rel=0.5)
