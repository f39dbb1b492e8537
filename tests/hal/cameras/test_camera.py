"""Tests of the camera service, which never lets the loop wait, of its frame sources, and of pixel formats."""

from __future__ import annotations

import io
import itertools
import threading
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from hal.buses.system import SystemClock
from hal.drivers.camera import PIXEL_FORMATS, CameraCounts, FrameNumbers, PixelError, ServedCamera
from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding, OutOfRange, Refused
from sim_hal.clock import SimClock
from tests.hal.cameras.ioctl_camera import IoctlCamera
from tests.hal.cameras.rig import EXPOSURE_NS, Rig, settled, video_rig
from tests.manual_clock import ManualClock

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


@pytest.mark.parametrize("error", [OSError(19, "No such device"), RuntimeError("lost"), ValueError("bad")])
def test_a_camera_whose_driver_raises_another_exception_is_reopened(error: Exception) -> None:
    class Foreign(SlowCamera):
        broken = False
        openings = 0

        def open(self) -> None:
            self.openings += 1
            self.fail()

        def collect(self) -> Frame | None:
            self.fail()
            return super().collect()

        def close(self) -> None:
            self.fail()

        def fail(self) -> None:
            if self.broken:
                raise error

    device, clock = Foreign(), SimClock()
    device.go.set()
    camera = ServedCamera(device, clock)
    device.broken = True
    clock.sleep_until_ns(clock.now_ns() + 3_500_000_000)
    with pytest.raises(NotResponding, match=str(error.args[-1])):
        camera.poll()
    assert device.openings == 4, "one at the start, and one a second"
    device.broken = False
    clock.sleep_until_ns(clock.now_ns() + 1_500_000_000)
    camera.trigger(1_000_000)
    clock.sleep_until_ns(clock.now_ns() + 100_000_000)
    assert camera.poll() is not None
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
def test_frame_numbers_increase_across_the_wrap_of_the_count(counts: list[int], numbers: list[int]) -> None:
    frames = FrameNumbers(100)
    assert [frames.number(count) for count in counts] == numbers


def test_frame_numbers_increase_after_a_restart_of_the_camera() -> None:
    frames = FrameNumbers(100)
    first = [frames.number(count) for count in (0, 1, 2)]
    frames.begin_again()
    assert first + [frames.number(count) for count in (0, 1)] == [0, 1, 2, 3, 4]


PATIENCE_NS = 400_000_000


def test_no_frame_arrives_without_a_trigger(rig: Rig) -> None:
    assert rig.source.poll() is None
    assert rig.frame_within(PATIENCE_NS) is None


def test_a_trigger_gives_exactly_one_frame_exposed_after_it(rig: Rig) -> None:
    trigger_ns = rig.clock.now_ns()
    frame = rig.next_frame()
    assert frame.exposure_start_ns >= trigger_ns
    assert frame.exposure_ns == EXPOSURE_NS
    assert frame.exposure_start_ns + EXPOSURE_NS <= frame.arrival_ns <= rig.clock.now_ns()
    assert rig.frame_within(PATIENCE_NS) is None, "one trigger, one frame"


def test_pixels_are_rows_by_columns_and_whole_numbers(rig: Rig) -> None:
    pixels = rig.next_frame().pixels
    assert pixels.shape == rig.shape
    assert pixels.dtype in (np.uint8, np.uint16)
    assert pixels.flags.c_contiguous


def test_sequence_numbers_only_grow(rig: Rig) -> None:
    numbers = [rig.next_frame().sequence for _ in range(6)]
    assert all(later > earlier for earlier, later in itertools.pairwise(numbers))


def test_a_frame_keeps_its_pixels_when_others_follow(rig: Rig) -> None:
    first = rig.next_frame().pixels
    as_it_came = first.copy()
    others = [rig.next_frame().pixels for _ in range(6)]
    assert np.array_equal(first, as_it_came)
    assert not all(np.array_equal(first, other) for other in others)


def test_the_frame_after_a_second_trigger_belongs_to_the_second_trigger(rig: Rig) -> None:
    rig.source.trigger(EXPOSURE_NS)
    rig.wait(EXPOSURE_NS // 4)
    second_ns = rig.clock.now_ns()
    frame = rig.next_frame()
    assert frame.exposure_start_ns >= second_ns
    assert rig.frame_within(PATIENCE_NS) is None


def test_closing_twice_is_safe(rig: Rig) -> None:
    rig.source.trigger(EXPOSURE_NS)
    rig.source.close()
    rig.source.close()


def test_a_camera_that_is_gone_does_not_answer_the_trigger(rig: Rig) -> None:
    if rig.unplug is None:
        pytest.skip("Aravis' Fake camera cannot be unplugged")
    rig.next_frame()
    rig.unplug()
    rig.wait(20_000_000)
    with pytest.raises(NotResponding):
        rig.source.trigger(EXPOSURE_NS)


BAYER = [name for name, coding in PIXEL_FORMATS.items() if coding.is_bayer]
ORDERS = {"BA81": "BGGR", "GBRG": "GBRG", "GRBG": "GRBG", "RGGB": "RGGB"}


def read(name: str, data: bytes, columns: int, rows: int = 1, stride: int = 0) -> npt.NDArray[Any]:
    coding = PIXEL_FORMATS[name]
    found: npt.NDArray[Any] = coding.image(
        np.frombuffer(data, np.uint8), columns, rows, stride or coding.row_bytes(columns)
    )
    return found


@pytest.mark.parametrize(
    ("name", "data", "pixels"),
    [
        # Y'00[9:2], Y'01[9:2], Y'02[9:2], Y'03[9:2], Y'03[1:0] Y'02[1:0] Y'01[1:0] Y'00[1:0]
        ("Y10P", "ff 00 80 01 e4", [0x3FC, 0x001, 0x202, 0x007]),
        # Y'00[11:4], Y'01[11:4], Y'01[3:0] Y'00[3:0]
        ("Y12P", "ab 12 3c", [0xABC, 0x123]),
        # Y'00[9:2], Y'00[1:0] Y'01[9:4], Y'01[3:0] Y'02[9:6], Y'02[5:0] Y'03[9:8], Y'03[7:0]
        ("Y10B", "ff c0 00 0a 01", [0x3FF, 0x000, 0x002, 0x201]),
        # Y'00[7:0], Y'00[9:8] in the low bits of the second byte
        ("Y10", "34 02 ff 03", [0x234, 0x3FF]),
        ("Y12", "bc 0a ff 0f", [0xABC, 0xFFF]),
        ("Y14", "ff 3f 01 00", [0x3FFF, 1]),
        ("Y16", "34 12 ff ff", [0x1234, 0xFFFF]),
        # Y'00[15:8], Y'00[7:0]
        ("Y16-BE", "12 34 ff fe", [0x1234, 0xFFFE]),
        ("GREY", "00 7f ff", [0, 127, 255]),
        # Y'0, Cb0, Y'1, Cr0
        ("YUYV", "10 80 20 81 30 82 40 83", [0x10, 0x20, 0x30, 0x40]),
        # Cb0, Y'0, Cr0, Y'1
        ("UYVY", "80 10 81 20", [0x10, 0x20]),
    ],
)
def test_the_bytes_of_the_documentation_are_the_pixels(name: str, data: str, pixels: list[int]) -> None:
    assert read(name, bytes.fromhex(data), len(pixels)).tolist() == [pixels]


@given(st.integers(1, 40), st.integers(1, 6), st.integers(0, 9), st.integers(0, 2**32 - 1))
def test_packed_pixels_are_read_again_with_padded_rows(
    columns: int, rows: int, padding: int, seed: int
) -> None:
    image = np.random.default_rng(seed).integers(0, 1 << 10, (rows, columns))
    wide = np.zeros((rows, -(-columns // 4) * 4), dtype=int)
    wide[:, :columns] = image
    lines = {"Y10P": b"", "Y10B": b"", "Y12P": b""}
    for row in wide.tolist():
        end = b"\xaa" * padding
        for a, b, c, d in zip(*[iter(row)] * 4, strict=True):
            low = a & 3 | (b & 3) << 2 | (c & 3) << 4 | (d & 3) << 6
            lines["Y10P"] += bytes([a >> 2, b >> 2, c >> 2, d >> 2, low])
            lines["Y10B"] += (a << 30 | b << 20 | c << 10 | d).to_bytes(5, "big")
        pairs = list(zip(*[iter(row[: -(-columns // 2) * 2])] * 2, strict=True))
        lines["Y12P"] += b"".join(bytes([a >> 4, b >> 4, a & 15 | (b & 15) << 4]) for a, b in pairs)
        lines = {name: data + end for name, data in lines.items()}
    for name, data in lines.items():
        stride = PIXEL_FORMATS[name].row_bytes(columns) + padding
        found = read(name, data, columns, rows, stride)
        assert found.dtype == np.uint16
        assert np.array_equal(found, image)


def mosaic(order: str, colours: dict[str, int], shape: tuple[int, int]) -> npt.NDArray[np.int_]:
    tile = np.array([[colours[order[0]], colours[order[1]]], [colours[order[2]], colours[order[3]]]])
    return np.tile(tile, (shape[0] // 2, shape[1] // 2))


@pytest.mark.parametrize("name", ORDERS)
def test_each_order_of_a_mosaic_gives_the_same_grey_to_its_edges(name: str) -> None:
    raw = mosaic(ORDERS[name], {"R": 40, "G": 200, "B": 120}, (8, 12)).astype(np.uint8)
    grey = read(name, raw.tobytes(), 12, 8)
    assert grey.dtype == np.uint8
    assert np.unique(grey).tolist() == [(40 + 2 * 200 + 120) // 4]


@pytest.mark.parametrize("name", BAYER)
def test_every_depth_of_a_mosaic_keeps_its_range(name: str) -> None:
    coding = PIXEL_FORMATS[name]
    data = b"\xff" * (coding.row_bytes(8) * 4)
    if coding.packing == "<u2":
        data = ((1 << coding.bits) - 1).to_bytes(2, "little") * 32
    assert np.unique(read(name, data, 8, 4)).tolist() == [(1 << coding.bits) - 1]


def test_a_red_star_on_a_mosaic_stays_where_it_is() -> None:
    y, x = np.mgrid[:32, :32]
    sensitive = mosaic("RGGB", {"R": 100, "G": 35, "B": 10}, (32, 32)) / 100.0
    for place in ((15.0, 16.0), (15.4, 16.7), (16.2, 15.1)):
        star = 40_000.0 * np.exp(-0.5 * ((y - place[0]) ** 2 + (x - place[1]) ** 2) / 1.5**2)
        raw = np.round(star * sensitive).astype("<u2")
        grey = read("RG16", raw.tobytes(), 32, 32).astype(float)
        found = np.array([(grey * y).sum(), (grey * x).sum()]) / grey.sum()
        assert np.abs(found - place).max() < 0.05


def jpeg(image: npt.NDArray[np.uint8], mode: str = "L") -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).convert(mode).save(file, "JPEG", quality=95)
    return file.getvalue()


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_motion_jpeg_is_decoded_to_its_luma(mode: str) -> None:
    y, x = np.mgrid[:48, :64]
    image = (x * 2 + y).astype(np.uint8)
    found = read("MJPG", jpeg(image, mode), 64, 48)
    assert found.dtype == np.uint8
    assert np.abs(found.astype(int) - image).max() <= 4


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "damaged JPEG"),
        (b"\xff\xd8\xff" + bytes(100), "damaged JPEG"),
        (jpeg(np.zeros((48, 64), np.uint8))[:-200], "damaged JPEG"),
        (jpeg(np.zeros((24, 32), np.uint8)), "a JPEG of 32 x 24 pixels, not 64 x 48"),
    ],
)
def test_a_damaged_jpeg_is_named(data: bytes, problem: str) -> None:
    with pytest.raises(PixelError, match=problem):
        read("MJPG", data, 64, 48)


@given(st.binary(max_size=600), st.sampled_from([*PIXEL_FORMATS]), st.integers(1, 20), st.integers(1, 20))
def test_any_bytes_are_an_image_or_an_error(data: bytes, name: str, columns: int, rows: int) -> None:
    try:
        found = read(name, data, columns, rows)
    except PixelError:
        return
    assert found.shape == (rows, columns)


def test_frames_of_a_packed_camera_arrive_as_pixels(kernel: IoctlCamera, clock: ManualClock) -> None:
    kernel.sizes = {"Y10P": (64, 48)}
    kernel.raw = bytes([0x40, 0x80, 0xC0, 0xFF, 0b11_10_01_00] * 16 * 48)
    video = settled(kernel, clock, pixel_format="Y10P")
    pixels = video.rig.next_frame().pixels
    assert pixels.shape == (48, 64)
    assert pixels[7, 8:12].tolist() == [0x100, 0x201, 0x302, 0x3FF]
    video.camera.close()


def test_frames_of_a_jpeg_camera_arrive_and_damaged_ones_are_counted(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    kernel.sizes = {"MJPG": (64, 48)}
    kernel.raw = jpeg(np.full((48, 64), 77, np.uint8))
    video = settled(kernel, clock, pixel_format="MJPG")
    assert int(video.rig.next_frame().pixels[20, 20]) == 77
    kernel.raw = kernel.raw[:200]
    video.camera.trigger(40_000_000)
    assert video.rig.frame_within(200_000_000) is None
    assert video.camera.counts.spoiled > 0
    video.camera.close()


def test_motion_jpeg_without_pillow_is_refused_with_its_cure(
    kernel: IoctlCamera, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel.sizes = {"MJPG": (64, 48)}
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(Refused, match=r"Motion JPEG needs Pillow: pip install 'knightcube-flight\[images\]'"):
        video_rig(kernel, clock, pixel_format="MJPG")


@pytest.mark.parametrize("absurd_ns", [10**18, 0, 1, 86_400 * 10**9])
def test_a_frame_with_an_absurd_stamp_costs_that_frame_alone(
    kernel: IoctlCamera, clock: ManualClock, absurd_ns: int
) -> None:
    video = settled(kernel, clock)
    last = max(kernel.exposures)
    kernel.absurd = {last + 2: absurd_ns}
    video.rig.wait(60_000_000)
    first = video.rig.next_frame()
    assert first.sequence not in kernel.absurd
    assert abs(first.exposure_start_ns - kernel.exposures[first.sequence][0]) < 1000
    video.rig.wait(200_000_000)
    counts = video.camera.counts
    assert (counts.absurd, counts.contradictory, counts.openings, counts.missed) == (1, 0, 1, 0)
    video.camera.close()


def test_a_stall_is_measured_from_the_first_unanswered_trigger(
    kernel: IoctlCamera, clock: ManualClock
) -> None:
    video = settled(kernel, clock)
    assert video.rig.next_frame() is not None
    kernel.stopped = True
    begin_ns = clock.now_ns()

    def trigger_every_second() -> None:
        while clock.now_ns() - begin_ns < 20_000_000_000:
            video.camera.trigger(40_000_000)
            video.rig.wait(1_000_000_000)

    with pytest.raises(NotResponding, match="no frame arrived after the trigger"):
        trigger_every_second()
    assert clock.now_ns() - begin_ns < 5_000_000_000
    kernel.stopped = False
    video.rig.wait(2_500_000_000)
    assert video.rig.next_frame() is not None
    video.camera.close()
