"""Tests of the V4L2 driver: the frame that belongs to a trigger, dropped frames, and messages of refusals."""

from __future__ import annotations

import errno
import os
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from hal.drivers import v4l2_camera as v4l2
from hal.drivers.v4l2_camera import Stamp, VideoDevice
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused
from tests.hal.cameras.ioctl_camera import IoctlCamera, Knob
from tests.hal.cameras.rig import EXPOSURE_NS, settled, video_rig
from tests.manual_clock import ManualClock

SECOND_NS = 1_000_000_000
MICROSECOND_NS = 1_000


def virtual_camera() -> str | None:
    """Return the device file of a virtual camera of the kernel (module `vivid`), or None."""
    for name in sorted(Path("/sys/class/video4linux").glob("video*/name")):
        if name.read_text(encoding="utf-8").strip().endswith("-vid-cap"):
            return f"/dev/{name.parent.name}"
    return None


VIRTUAL = virtual_camera()


@pytest.mark.skipif(VIRTUAL is None, reason="this kernel has no virtual camera: `modprobe vivid` makes one")
def test_a_virtual_camera_of_the_kernel_delivers_frames_and_is_refused_for_its_missing_control() -> None:
    assert VIRTUAL is not None
    with closing(VideoDevice(VIRTUAL)) as device:
        assert "GREY" in list(device.formats())
        layout = device.set_format(640, 360, "GREY")
        assert (layout.fourcc, layout.columns, layout.rows) == ("GREY", 640, 360)
        device.start(3)
        numbers: list[int] = []
        until = time.monotonic() + 300.0
        while len(numbers) < 4 and time.monotonic() < until:
            time.sleep(0.02)
            while (filled := device.dequeue()) is not None:
                numbers.append(filled.sequence)
                device.queue(filled.index)
        assert numbers == sorted(set(numbers))
        assert len(numbers) >= 4
        with pytest.raises(Refused, match="no exposure control"):
            v4l2.manual_exposures(VIRTUAL, device, "vivid")


def test_the_first_whole_exposure_after_the_trigger_is_taken(kernel: IoctlCamera, clock: ManualClock) -> None:
    video = settled(kernel, clock)
    for odd_ns in (0, 7_000_000, 11_000_000, 39_000_000):
        video.rig.wait(200_000_000 + odd_ns)
        trigger_ns = clock.now_ns()
        frame = video.rig.next_frame()
        starts = [start for start, _ in kernel.exposures.values() if start >= trigger_ns]
        assert abs(frame.exposure_start_ns - min(starts)) < MICROSECOND_NS
    video.camera.close()


def test_frames_from_before_the_trigger_are_not_used(kernel: IoctlCamera, clock: ManualClock) -> None:
    with closing(VideoDevice(str(kernel.path))) as device:
        device.set_format(64, 48, "GREY")
        assert device.start(3) == 3
        # The driver dequeues no frame. Three old frames are in the queue, and later frames are lost.
        clock.advance(SECOND_NS)
        numbers = []
        while (filled := device.dequeue()) is not None:
            numbers.append(filled.sequence)
            device.queue(filled.index)
        assert numbers == [0, 1, 2]
        clock.advance(60_000_000)
        later = device.dequeue()
        assert later is not None
        assert later.sequence > 30


def test_the_start_of_the_exposure_follows_from_a_stamp_of_the_end_of_the_frame(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    kernel.stamp_source = 0
    video = settled(kernel, clock, stamp_delay_ns=kernel.readout_ns)
    frame = video.rig.next_frame()
    assert abs(frame.exposure_start_ns - kernel.exposures[frame.sequence][0]) < MICROSECOND_NS
    video.camera.close()


@pytest.mark.parametrize(("stated", "at_start"), [("1", True), ("0", False), (None, False)])
def test_uvc_stamps_are_of_the_start_only_when_the_kernel_uses_the_cameras_clock(
    kernel: IoctlCamera, clock: ManualClock, stated: str | None, at_start: bool
) -> None:
    kernel.driver = b"uvcvideo"
    if stated is not None:
        (kernel.path.parent / "hwtimestamps").write_text(stated + "\n", encoding="ascii")
    kernel.stamps_packets = not at_start
    video = settled(kernel, clock)
    frame = video.rig.next_frame()
    assert abs(frame.exposure_start_ns - kernel.exposures[frame.sequence][0]) < MICROSECOND_NS
    video.camera.close()


@pytest.mark.parametrize("stamp", [Stamp.START, Stamp.END])
def test_the_configuration_can_state_to_what_the_time_stamps_refer(
    kernel: IoctlCamera, clock: ManualClock, stamp: Stamp
) -> None:
    kernel.stamp_source = v4l2.STAMP_START_OF_EXPOSURE if stamp is Stamp.END else 0
    video = settled(kernel, clock, stamp=stamp)
    frame = video.rig.next_frame()
    start_ns = kernel.exposures[frame.sequence][0]
    lie_ns = -EXPOSURE_NS if stamp is Stamp.END else EXPOSURE_NS + kernel.readout_ns
    assert abs(frame.exposure_start_ns - start_ns - lie_ns) < MICROSECOND_NS
    video.camera.close()


def test_a_changed_exposure_is_waited_for_until_frames_have_it(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    video = settled(kernel, clock)
    for exposure_ns in (60_000_000, 21_000_000):
        trigger_ns = clock.now_ns()
        video.camera.trigger(exposure_ns)
        frame = video.rig.frame_within(SECOND_NS)
        assert frame is not None
        assert frame.exposure_ns == exposure_ns == kernel.exposures[frame.sequence][1]
        assert frame.exposure_start_ns >= trigger_ns
    video.camera.close()


def test_the_reported_exposure_is_the_one_that_the_camera_has_set(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    video = settled(kernel, clock)
    video.camera.trigger(30_033_000)
    frame = video.rig.frame_within(SECOND_NS)
    assert frame is not None
    assert frame.exposure_ns == 30_000_000
    video.camera.close()


@pytest.mark.parametrize(
    ("kind", "dtype", "bits"), [("GREY", np.uint8, 8), ("Y10", np.uint16, 10), ("Y16", np.uint16, 16)]
)
def test_pixels_are_read_without_the_padding_of_the_rows(
    kernel: IoctlCamera, clock: ManualClock, kind: str, dtype: type, bits: int
) -> None:
    kernel.padding = 24
    video = settled(kernel, clock, pixel_format=kind)
    pixels = video.rig.next_frame().pixels
    y, x = np.mgrid[:48, :64]
    assert pixels.dtype == dtype
    assert np.array_equal(pixels, (int(pixels[0, 0]) + x + 100 * y) % (1 << bits))
    video.camera.close()


def test_spoiled_and_short_frames_are_dropped_and_counted(kernel: IoctlCamera, clock: ManualClock) -> None:
    video = settled(kernel, clock)
    last = max(kernel.exposures)
    kernel.spoil = {last + 2, last + 3}
    kernel.shorten = {last + 4}
    frame = video.rig.next_frame()
    assert frame.sequence == last + 5
    assert (video.camera.counts.spoiled, video.camera.counts.short) == (2, 1)
    assert video.camera.counts.missed == 0
    video.camera.close()


def test_a_gap_in_the_sequence_is_counted_and_shows_in_the_frames_number(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    video = settled(kernel, clock)
    before = video.rig.next_frame().sequence
    kernel._sequence += 7
    after = video.rig.next_frame().sequence
    assert after - before > 7
    assert video.camera.counts.missed == 7
    video.camera.close()


def test_a_frozen_sequence_is_passed_on_as_it_stands(kernel: IoctlCamera, clock: ManualClock) -> None:
    video = settled(kernel, clock)
    kernel.frozen = True
    numbers = {video.rig.next_frame().sequence for _ in range(3)}
    assert len(numbers) == 1
    video.camera.close()


def test_sequence_numbers_increase_across_the_wrap_of_the_count_of_the_kernel(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    kernel.first_sequence = (1 << 32) - 12
    video = video_rig(kernel, clock)
    numbers = [video.rig.next_frame().sequence for _ in range(8)]
    assert numbers == sorted(set(numbers))
    assert numbers[0] < 1 << 32 < numbers[-1] < (1 << 32) + 40
    assert video.camera.counts.missed == 0
    video.camera.close()


def test_a_late_frame_has_the_time_of_its_exposure(kernel: IoctlCamera, clock: ManualClock) -> None:
    video = settled(kernel, clock)
    kernel.held_ns = 1_500_000_000
    frame = video.rig.next_frame()
    assert frame.arrival_ns - frame.exposure_start_ns > kernel.held_ns
    video.camera.close()


def test_a_camera_whose_exposure_differs_from_the_reported_one_is_refused(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    video = settled(kernel, clock)
    assert video.rig.next_frame() is not None
    kernel.belies_exposure = True
    video.camera.trigger(EXPOSURE_NS)
    with pytest.raises(
        Refused, match=r"frames arrive every 20\.0 ms, which is shorter than the exposure of 40\.0 ms"
    ):
        video.rig.frame_within(SECOND_NS)
    assert video.camera.counts.contradictory == 3
    video.camera.close()


@pytest.mark.parametrize(
    ("clock_flag", "offset_ns", "message"),
    [
        (0, 0, "not from the monotonic clock"),
        (v4l2.STAMP_MONOTONIC, 10**18, "ahead of the monotonic clock: has uvcvideo"),
    ],
)
def test_stamps_of_another_clock_are_refused(
    kernel: IoctlCamera, clock: ManualClock, clock_flag: int, offset_ns: int, message: str
) -> None:
    kernel.clock_flag, kernel.stamp_offset_ns = clock_flag, offset_ns
    video = video_rig(kernel, clock)
    with pytest.raises(DeviceError, match=message):
        video.rig.frame_within(SECOND_NS)
    video.camera.close()


def test_an_unplugged_camera_is_reported_and_comes_back_by_itself(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    video = settled(kernel, clock)
    before = [video.rig.next_frame().sequence for _ in range(5)]
    kernel.unplug()
    video.rig.wait(20_000_000)
    with pytest.raises(NotResponding, match=r"the camera disappeared while .*: check its cable"):
        video.camera.poll()
    video.rig.wait(5 * SECOND_NS)
    with pytest.raises(NotResponding, match=r"no such camera.*udev rule"):
        video.camera.trigger(EXPOSURE_NS)
    kernel.plug()
    video.rig.wait(1_050_000_000)
    frame = video.rig.next_frame()
    assert frame.sequence > before[-1], "the kernel begins at 0 again, the frames' numbers do not"
    assert video.camera.counts.openings == 2
    assert video.camera.counts.missed == 0
    video.camera.close()


def test_a_camera_that_sends_no_frames_is_opened_again(kernel: IoctlCamera, clock: ManualClock) -> None:
    video = settled(kernel, clock)
    kernel.stopped = True
    video.camera.trigger(EXPOSURE_NS)
    assert video.rig.frame_within(3 * SECOND_NS) is None
    with pytest.raises(NotResponding, match="no frame arrived after the trigger"):
        video.rig.frame_within(SECOND_NS)
    kernel.stopped = False
    video.rig.wait(SECOND_NS)
    assert video.rig.next_frame() is not None
    video.camera.close()


def test_a_camera_without_a_pending_trigger_may_be_silent(kernel: IoctlCamera, clock: ManualClock) -> None:
    video = settled(kernel, clock)
    video.rig.next_frame()
    kernel.stopped = True
    video.rig.wait(60 * SECOND_NS)
    assert video.camera.poll() is None
    assert video.camera.counts.openings == 1
    video.camera.close()


def test_failed_ioctls_are_reported_and_frames_arrive_again_after_them(
    kernel: IoctlCamera, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = settled(kernel, clock)

    def fail(*_: object) -> int:
        raise OSError(5, os.strerror(5))

    with monkeypatch.context() as broken:
        broken.setattr("hal.drivers.v4l2_camera.ioctl", fail)
        video.rig.wait(400_000_000)
        assert video.camera.poll() is None, "it may pass"
        video.rig.wait(120_000_000)
        with pytest.raises(NotResponding, match="fetching a frame: Input/output error"):
            video.camera.poll()
    kernel._streamoff(None)  # type: ignore[arg-type]  # the driver's own request was among those that failed
    video.rig.wait(1_100_000_000)
    assert video.rig.next_frame() is not None
    video.camera.close()


def test_an_input_output_error_that_passes_costs_no_reopening(
    kernel: IoctlCamera, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A temporary EIO does not lead to a reopening of the camera.

    The kernel's documentation of VIDIOC_DQBUF states that EIO may mean a temporary loss of signal.
    """
    video = settled(kernel, clock)
    fetched = kernel._dqbuf

    def lose_signal(_: v4l2.Buffer) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    for _ in range(3):
        monkeypatch.setattr(kernel, "_dqbuf", lose_signal)
        video.rig.wait(300_000_000)
        monkeypatch.setattr(kernel, "_dqbuf", fetched)
        assert video.rig.next_frame() is not None
    assert video.camera.counts.openings == 1
    video.camera.close()


def test_a_name_cut_inside_a_character_is_accepted(kernel: IoctlCamera, clock: ManualClock) -> None:
    """A device name that the kernel has cut within a character is accepted.

    The kernel's fields have 32 bytes.
    """
    kernel.card = "Caméra de précision à l'été, é".encode()[:31]
    kernel.knobs[v4l2.GAIN].name = b"Verst\xc3"
    with pytest.raises(UnicodeDecodeError):
        kernel.card.decode()
    video = video_rig(kernel, clock, gain=5)
    assert video.rig.next_frame() is not None
    video.camera.close()
    kernel.capabilities = v4l2.CAP_STREAMING
    with pytest.raises(Refused, match="Caméra de précision"):
        video_rig(kernel, clock)


def test_exposures_that_the_camera_cannot_make_are_refused_with_its_limits(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    video = settled(kernel, clock)
    for exposure_ns in (0, 10_000, 600_000_000):
        with pytest.raises(OutOfRange) as caught:
            video.camera.trigger(exposure_ns)
        assert (caught.value.low, caught.value.high) == pytest.approx((1e-4, 0.5))
    assert video.rig.next_frame().exposure_ns == EXPOSURE_NS
    video.camera.close()


def test_the_camera_is_set_to_manual_with_its_gain_and_time_between_frames(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    kernel.knobs[v4l2.AUTO_GAIN] = Knob(0, 1, 1)
    video_rig(kernel, clock, gain=42).camera.close()
    assert kernel.knobs[v4l2.EXPOSURE_AUTO].value == v4l2.EXPOSURE_MANUAL
    assert kernel.knobs[v4l2.EXPOSURE_ABSOLUTE].value == 400
    assert (kernel.knobs[v4l2.AUTO_GAIN].value, kernel.knobs[v4l2.GAIN].value) == (0, 42)
    assert kernel.interval_asked_ns == EXPOSURE_NS


@pytest.mark.parametrize(
    ("control", "kept", "message"),
    [
        (v4l2.GAIN, 35, "gain is 35 after 42 was set"),
        (v4l2.AUTO_GAIN, 1, "automatic gain is 1 after 0 was set"),
        (v4l2.EXPOSURE_AUTO, 3, "automatic exposure is 3 after 1 was set"),
    ],
)
def test_a_camera_that_does_not_keep_a_control_is_refused(
    kernel: IoctlCamera, clock: ManualClock, control: int, kept: int, message: str
) -> None:
    kernel.knobs[v4l2.AUTO_GAIN] = Knob(0, 1, 1)
    kernel.stubborn[control] = kept
    with pytest.raises(Refused, match=message):
        video_rig(kernel, clock, gain=42)


def test_a_camera_may_round_its_gain_to_a_step(kernel: IoctlCamera, clock: ManualClock) -> None:
    kernel.stubborn[v4l2.GAIN] = 48
    video_rig(kernel, clock, gain=42).camera.close()


@pytest.mark.parametrize(
    ("intervals_ms", "chosen_ms"),
    [((33, 66), 66), ((39, 80), 39), ((10, 20, 200), 200), ((10, 20), 20), ((40,), 40)],
)
def test_the_time_between_frames_is_not_shorter_than_the_exposure(
    kernel: IoctlCamera, clock: ManualClock, intervals_ms: tuple[int, ...], chosen_ms: int
) -> None:
    """The kernel chooses the nearest interval of the camera, which may be shorter than the exposure."""
    assert EXPOSURE_NS == 40_000_000
    kernel.intervals_ns = tuple(1_000_000 * one for one in intervals_ms)
    video_rig(kernel, clock).camera.close()
    assert kernel.interval_asked_ns == 1_000_000 * chosen_ms


def test_a_missing_device_file_is_reported_with_the_remedy(
    tmp_path: Path, kernel: IoctlCamera, clock: ManualClock
) -> None:
    with pytest.raises(NotResponding, match=r"nothing: no such camera.*v4l2-ctl --list-devices"):
        video_rig(kernel, clock, path=str(tmp_path / "nothing"))


def test_a_path_that_is_not_a_video_device_is_refused(tmp_path: Path, clock: ManualClock) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"")
    kernel = IoctlCamera(tmp_path, clock.now_ns)  # the driver calls the real kernel in this test
    with pytest.raises(Refused, match="is not a V4L2 device"):
        video_rig(kernel, clock, path=str(path))
    kernel.close()


def test_a_node_that_captures_nothing_is_refused(kernel: IoctlCamera, clock: ManualClock) -> None:
    kernel.capabilities = v4l2.CAP_STREAMING  # capabilities as of the metadata node of a UVC camera
    with pytest.raises(Refused, match="cannot capture video: use its capture device"):
        video_rig(kernel, clock)


def test_a_camera_that_another_program_has_is_refused(kernel: IoctlCamera, clock: ManualClock) -> None:
    kernel._count = 4
    with pytest.raises(Refused, match="another program uses the camera"):
        video_rig(kernel, clock)


def test_a_camera_on_an_exhausted_usb_bus_is_refused_with_the_cure(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    kernel.bandwidth = False
    with pytest.raises(Refused, match=r"bandwidth of its USB bus is exhausted.*another USB controller"):
        video_rig(kernel, clock)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel_format": "Y12"}, "no pixel format Y12; it offers GREY, Y10, Y16"),
        ({"columns": 640}, "gives 64 x 48 pixels, not 640 x 48"),
        ({"gain": 300}, r"gain = 300 is outside 0 to 100$"),
        ({"exposure_ns": 2 * SECOND_NS}, r"exposure = 2\.0 is outside .* s$"),
    ],
)
def test_settings_that_the_camera_does_not_support_are_refused(
    kernel: IoctlCamera, clock: ManualClock, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(DeviceError, match=message):
        video_rig(kernel, clock, **changes)
    assert not kernel._streaming, "nothing is left running"


@pytest.mark.parametrize(
    ("missing", "message"),
    [(v4l2.EXPOSURE_ABSOLUTE, "no exposure control in units of time"), (v4l2.GAIN, "omit `gain`")],
)
def test_a_camera_without_the_control_is_refused(
    kernel: IoctlCamera, clock: ManualClock, missing: int, message: str
) -> None:
    del kernel.knobs[missing]
    with pytest.raises(Refused, match=message):
        video_rig(kernel, clock, gain=5)
