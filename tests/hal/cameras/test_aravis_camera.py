"""Tests of the GenICam driver with the Fake camera of Aravis, and of its message if Aravis is missing."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from hal.buses.system import SystemClock
from hal.drivers.aravis_camera import AravisCamera, AravisSettings
from hal.drivers.camera import ServedCamera
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused
from tests.hal.cameras.rig import EXPOSURE_NS, Rig, aravis_rig, require_aravis

MILLISECOND_NS = 1_000_000


@pytest.fixture
def fake() -> Iterator[AravisCamera]:
    """Open the Fake camera of Aravis without a ServedCamera."""
    require_aravis()
    camera = AravisCamera(AravisSettings("Fake_1", 512, 256, "Mono16", EXPOSURE_NS, None), SystemClock())
    camera.open()
    yield camera
    camera.close()


@pytest.mark.parametrize(("kind", "dtype"), [("Mono8", np.uint8), ("Mono16", np.uint16)])
def test_pixels_have_the_width_of_their_format(kind: str, dtype: type) -> None:
    rig = aravis_rig(pixel_format=kind)
    pixels = rig.next_frame().pixels
    assert pixels.dtype == dtype
    assert pixels.max() > pixels.min(), "the Fake camera draws a gradient"
    rig.source.close()


def test_the_exposure_can_be_changed_from_frame_to_frame() -> None:
    rig = aravis_rig()
    for exposure_ns in (20 * MILLISECOND_NS, 60 * MILLISECOND_NS):
        trigger_ns = rig.clock.now_ns()
        rig.source.trigger(exposure_ns)
        frame = rig.frame_within(1000 * MILLISECOND_NS)
        assert frame is not None
        assert frame.exposure_ns == exposure_ns
        assert trigger_ns <= frame.exposure_start_ns <= trigger_ns + 100 * MILLISECOND_NS
        assert frame.arrival_ns >= frame.exposure_start_ns + exposure_ns
    rig.source.close()


def test_an_exposure_beyond_the_cameras_is_refused_with_its_limits() -> None:
    rig = aravis_rig()
    with pytest.raises(OutOfRange) as caught:
        rig.source.trigger(11_000 * MILLISECOND_NS)
    assert (caught.value.low, caught.value.high) == pytest.approx((1e-5, 10.0))
    rig.source.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "Fake_7"}, "there is .*is it plugged in"),
        ({"pixel_format": "Mono12"}, "no pixel format Mono12; it offers .*Mono8"),
        ({"columns": 4096}, "sensor has 2048 x 2048 pixels; 4096 x 256 are requested"),
        ({"gain": 99.0}, "gain = 99.0"),
        ({"exposure_ns": 20_000 * MILLISECOND_NS}, "exposure = 20.0 s"),
    ],
)
def test_settings_that_the_camera_does_not_support_are_refused(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(DeviceError, match=message):
        aravis_rig(**changes)


def test_a_camera_whose_control_is_lost_is_reported_and_opened_again() -> None:
    require_aravis()
    clock = SystemClock()
    device = AravisCamera(AravisSettings("Fake_1", 512, 256, "Mono8", EXPOSURE_NS, None), clock)
    source = ServedCamera(device, clock)
    rig = Rig(source, clock, (256, 512), None)
    before = rig.next_frame().sequence
    device._camera.get_device().emit("control-lost")
    rig.wait(50 * MILLISECOND_NS)
    with pytest.raises(NotResponding, match="the camera disappeared: check its cable"):
        source.poll()
    rig.wait(1100 * MILLISECOND_NS)
    assert rig.next_frame().sequence > before
    assert source.counts.openings == 2
    source.close()


def test_frames_without_a_trigger_are_returned_to_the_stream(fake: AravisCamera) -> None:
    clock = SystemClock()
    deadline_ns = clock.now_ns() + 500 * MILLISECOND_NS
    while clock.now_ns() < deadline_ns:  # the Fake camera sends frames without a trigger
        assert fake.collect() is None
        clock.sleep_until_ns(clock.now_ns() + 10 * MILLISECOND_NS)
    fake.expose(EXPOSURE_NS, clock.now_ns())
    assert fake.collect() is None
    assert fake.counts.spoiled == 0


def test_without_aravis_the_remedy_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    monkeypatch.setitem(sys.modules, "gi", None)  # makes an import of gi fail
    camera = AravisCamera(AravisSettings("Fake_1", 512, 256, "Mono8", EXPOSURE_NS, None), SystemClock())
    with pytest.raises(
        Refused, match=r"apt install gir1.2-aravis-0.8.*pip install 'knightcube-flight\[genicam\]'"
    ):
        camera.open()
    camera.close()
