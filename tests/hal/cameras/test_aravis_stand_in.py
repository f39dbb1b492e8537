"""Tests of the Aravis driver with a test double of the library: configuration, exposures, accepted frames."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hal.drivers import aravis_camera
from hal.drivers.aravis_camera import AravisCamera, AravisSettings
from hal.interfaces.errors import NotResponding, OutOfRange, Refused
from tests.manual_clock import ManualClock

MS = 1_000_000


class GlibError(Exception):
    """Test double of GLib.Error."""


class FakeBuffer:
    """A frame buffer."""

    def __init__(self, number: int, data: bytes, status: int = 0) -> None:
        self.number, self.data, self.status = number, data, status

    def get_frame_id(self) -> int:
        return self.number

    def get_data(self) -> bytes:
        return self.data

    def get_status(self) -> int:
        return self.status


class FakeStream:
    """A stream with a queue of completed buffers."""

    def __init__(self) -> None:
        self.finished: list[FakeBuffer] = []
        self.given: list[Any] = []

    def push_buffer(self, buffer: Any) -> None:
        self.given.append(buffer)

    def try_pop_buffer(self) -> FakeBuffer | None:
        return self.finished.pop(0) if self.finished else None


class FakeCamera:
    """A camera that records its settings."""

    def __init__(self, **changes: Any) -> None:
        self.known: dict[str, Any] = {
            "software": True,
            "formats": ["Mono8", "Mono12"],
            "sensor": (1001, 803),
            "steps": (8, 4),
            "region": None,
            "exposure_bounds": (10.0, 2e6),
            "gain_bounds": (0.0, 24.0),
            "gain": True,
            "auto": True,
            "stream": FakeStream(),
            "failing": "",
            "acquiring": False,
            **changes,
        }
        self.set: dict[str, Any] = {}
        self.triggers = 0
        self.stopped = 0
        self.lost: Any = None

    def _may_fail(self, name: str) -> None:
        if self.known["failing"] == name:
            raise GlibError(f"{name} failed")

    def is_software_trigger_supported(self) -> bool:
        return bool(self.known["software"])

    def get_model_name(self) -> str:
        return "model X"

    def dup_available_pixel_formats_as_strings(self) -> list[str]:
        return list(self.known["formats"])

    def set_pixel_format_from_string(self, name: str) -> None:
        self._may_fail("format")
        if self.known["acquiring"]:
            raise GlibError("PixelFormat is locked")
        self.set["format"] = name

    def get_sensor_size(self) -> tuple[int, int]:
        return self.known["sensor"]  # type: ignore[no-any-return]  # two numbers

    def get_x_offset_increment(self) -> int:
        return int(self.known["steps"][0])

    def get_y_offset_increment(self) -> int:
        return int(self.known["steps"][1])

    def set_region(self, *region: int) -> None:
        self.set["region"] = region

    def get_region(self) -> tuple[int, ...]:
        return self.known["region"] or self.set["region"]  # type: ignore[no-any-return]  # four numbers

    def is_gain_auto_available(self) -> bool:
        return bool(self.known["auto"])

    def is_exposure_auto_available(self) -> bool:
        return bool(self.known["auto"])

    def set_gain_auto(self, value: str) -> None:
        self.set["gain auto"] = value

    def set_exposure_time_auto(self, value: str) -> None:
        self.set["exposure auto"] = value

    def is_gain_available(self) -> bool:
        return bool(self.known["gain"])

    def get_gain_bounds(self) -> tuple[float, float]:
        return self.known["gain_bounds"]  # type: ignore[no-any-return]  # two numbers

    def set_gain(self, gain: float) -> None:
        self.set["gain"] = gain

    def get_gain(self) -> float:
        return float(self.set["gain"]) + float(self.known.get("gain_error", 0.0))

    def get_exposure_time_bounds(self) -> tuple[float, float]:
        low, high = self.known["exposure_bounds"]
        # Like many cameras, the camera has a frame rate, 30 per second, until a trigger is set.
        return low, high if "trigger" in self.set else min(high, 33_333.0)

    def set_exposure_time(self, microseconds: float) -> None:
        self.set["exposure"] = microseconds

    def get_exposure_time(self) -> float:
        return float(self.set["exposure"]) + 5.0

    def set_acquisition_mode(self, mode: str) -> None:
        self.set["mode"] = mode

    def set_trigger(self, source: str) -> None:
        self.set["trigger"] = source

    def create_stream(self, *_: Any) -> Any:
        return self.known["stream"]

    def get_payload(self) -> int:
        return 99

    def get_device(self) -> Any:
        return SimpleNamespace(connect=self._connect)

    def _connect(self, signal: str, handler: Any) -> None:
        assert signal == "control-lost"
        self.lost = handler

    def start_acquisition(self) -> None:
        self.set["started"] = self.known["acquiring"] = True

    def stop_acquisition(self) -> None:
        self.stopped += 1
        self._may_fail("stop")
        self.known["acquiring"] = False

    def software_trigger(self) -> None:
        self._may_fail("trigger")
        self.triggers += 1


class Rig:
    """A driver on a fake camera."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], **camera: Any) -> None:
        self.camera = FakeCamera(**camera)
        self.clock = ManualClock(0)
        self.interfaces: list[str] = []
        library = SimpleNamespace(
            enable_interface=self.interfaces.append,
            Camera=SimpleNamespace(new=self._new),
            Auto=SimpleNamespace(OFF="off"),
            AcquisitionMode=SimpleNamespace(CONTINUOUS="continuous"),
            BufferStatus=SimpleNamespace(SUCCESS=0),
            Buffer=SimpleNamespace(new_allocate=lambda size: ("buffer", size)),
            update_device_list=lambda: None,
            get_n_devices=lambda: 2,
            get_device_id=lambda index: f"camera-{index}",
        )
        monkeypatch.setattr(aravis_camera, "library", lambda _: library)
        monkeypatch.setattr(aravis_camera, "_glib_error", lambda: GlibError)
        plain = {"name": "X1", "columns": 640, "rows": 480, "pixel_format": "Mono12", "exposure_ns": 20 * MS}
        self.driver = AravisCamera(AravisSettings(**{**plain, "gain": 6.0, **settings}), self.clock)
        self.missing = False

    def _new(self, name: str) -> FakeCamera:
        assert name == self.driver.name
        if self.missing:
            raise GlibError("not found")
        return self.camera

    @property
    def stream(self) -> FakeStream:
        """The camera's stream."""
        found: FakeStream = self.camera.known["stream"]
        return found

    def arrive(self, number: int, status: int = 0, size: int = 640 * 480 * 2) -> None:
        """Complete a buffer of the stream."""
        data = (np.arange(size // 2) % 4096).astype("<u2").tobytes()
        self.stream.finished.append(FakeBuffer(number, data, status))


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    """Return an open driver."""
    made = Rig(monkeypatch, {})
    made.driver.open()
    return made


def test_the_camera_is_set_up_as_configured(rig: Rig) -> None:
    assert rig.camera.set == {
        "format": "Mono12", "region": (176, 160, 640, 480), "gain auto": "off", "gain": 6.0,
        "exposure auto": "off", "exposure": 20_000.0, "mode": "continuous", "trigger": "Software",
        "started": True,
    }  # fmt: skip
    assert rig.stream.given == [("buffer", 99)] * 4
    assert rig.interfaces == []


def test_a_camera_without_automatic_modes_keeps_its_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(
        monkeypatch, {"name": "Fake_1", "gain": None, "pixel_format": "Mono8"}, auto=False, steps=(0, 0)
    )
    rig.driver.open()
    assert rig.interfaces == ["Fake"]
    assert rig.camera.set["region"] == (180, 161, 640, 480)
    assert not {"gain", "gain auto", "exposure auto"} & set(rig.camera.set)


@pytest.mark.parametrize(
    ("settings", "camera", "error", "complaint"),
    [
        ({}, {"software": False}, Refused, "model X"),
        ({"pixel_format": "Mono16"}, {}, Refused, "Mono8, Mono12"),
        ({"columns": 1002}, {}, Refused, "1001 x 803"),
        ({"rows": 804}, {}, Refused, "1001 x 803"),
        ({}, {"region": (0, 0, 632, 480)}, Refused, "632 x 480"),
        ({}, {"gain": False}, Refused, "gain"),
        ({}, {"gain_error": 0.5}, Refused, "gain is 6.5 after 6 was set"),
        ({"gain": 24.5}, {}, OutOfRange, "gain"),
        ({"gain": -0.5}, {}, OutOfRange, "gain"),
        ({"exposure_ns": 9_999}, {}, OutOfRange, "exposure"),
        ({"exposure_ns": 2_000_000_001}, {}, OutOfRange, "exposure"),
        ({}, {"stream": None}, NotResponding, "stream"),
        ({}, {"failing": "format"}, NotResponding, "format failed"),
    ],
)
def test_a_camera_that_cannot_be_set_up_is_refused(
    monkeypatch: pytest.MonkeyPatch,
    settings: dict[str, Any],
    camera: dict[str, Any],
    error: type[Exception],
    complaint: str,
) -> None:
    with pytest.raises(error, match=complaint):
        Rig(monkeypatch, settings, **camera).driver.open()


def test_the_bounds_of_gain_and_exposure_are_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    Rig(monkeypatch, {}, gain_error=0.2).driver.open()  # the gain of this camera has wide steps
    for gain, exposure in ((24.0, 10_000), (0.0, 2_000_000_000)):
        Rig(monkeypatch, {"gain": gain, "exposure_ns": exposure}).driver.open()
    Rig(monkeypatch, {"columns": 1001, "rows": 803}, steps=(1, 1)).driver.open()


def test_a_missing_camera_is_reported_with_those_that_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.missing = True
    with pytest.raises(NotResponding, match="camera-0, camera-1"):
        rig.driver.open()
    with pytest.raises(NotResponding, match="not open"):
        rig.driver.expose(20 * MS, 0)
    with pytest.raises(NotResponding, match="not open"):
        rig.driver.collect()


def test_a_triggered_frame_is_returned_once_after_its_exposure(rig: Rig) -> None:
    rig.clock.sleep_until_ns(100 * MS)
    rig.driver.expose(30 * MS, 0)
    assert (rig.camera.triggers, rig.camera.set["exposure"]) == (1, 30_000.0)
    rig.arrive(1)
    rig.clock.sleep_until_ns(130 * MS)
    assert rig.driver.collect() is None, "before the end of the exposure, which the camera made 5 us longer"
    rig.arrive(2)
    rig.clock.sleep_until_ns(130 * MS + 5_000)
    frame = rig.driver.collect()
    assert frame is not None
    assert (frame.exposure_start_ns, frame.exposure_ns, frame.arrival_ns) == (
        100 * MS,
        30_005_000,
        130_005_000,
    )
    assert (frame.pixels.shape, frame.pixels.dtype) == ((480, 640), np.dtype("uint16"))
    assert frame.pixels[0, :4].tolist() == [0, 1, 2, 3]
    rig.arrive(3)
    rig.clock.sleep_until_ns(500 * MS)
    assert rig.driver.collect() is None, "no exposure was triggered"
    assert len(rig.stream.given) == 4 + 3


def test_missed_spoiled_and_short_frames_are_counted(rig: Rig) -> None:
    rig.driver.expose(20 * MS, 0)
    assert rig.camera.set["exposure"] == 20_000.0
    rig.clock.sleep_until_ns(50 * MS)
    rig.arrive(1, status=3)
    rig.arrive(2, size=640 * 480 * 2 - 2)
    rig.arrive(6)
    frame = rig.driver.collect()
    assert frame is not None
    counts = rig.driver.counts
    assert (counts.spoiled, counts.short, counts.missed) == (1, 1, 3)
    rig.arrive(9)
    rig.driver.expose(20 * MS, 0)
    assert rig.driver.counts.missed == 5, "old frames are discarded at the next trigger, but counted"
    assert rig.driver.collect() is None


def test_frame_numbers_continue_after_their_largest_value(rig: Rig) -> None:
    numbers = []
    for number in (65_535, 1, 2):
        rig.driver.expose(20 * MS, 0)
        rig.clock.sleep_until_ns(rig.clock.now_ns() + 50 * MS)
        rig.arrive(number)
        frame = rig.driver.collect()
        assert frame is not None
        numbers.append(frame.sequence)
    assert np.diff(numbers).tolist() == [1, 1]
    assert rig.driver.counts.missed == 0


def test_a_camera_that_a_killed_program_left_acquiring_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {}, acquiring=True)
    rig.driver.open()
    assert rig.camera.set["format"] == "Mono12"
    assert rig.camera.set["started"]


def test_a_lost_camera_does_not_respond(rig: Rig) -> None:
    rig.camera.lost(None)
    with pytest.raises(NotResponding, match="disappeared"):
        rig.driver.collect()
    rig.camera.known["failing"] = "trigger"
    with pytest.raises(NotResponding, match="trigger failed"):
        rig.driver.expose(20 * MS, 0)
    rig.camera.known["failing"] = "stop"
    rig.driver.close()
    rig.driver.close()
    assert rig.camera.stopped == 2, "once when opened, and once when closed"
    rig.camera.known["failing"] = ""
    rig.driver.open()
    assert rig.driver.collect() is None, "open again"
