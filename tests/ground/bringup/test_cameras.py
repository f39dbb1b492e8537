"""Tests of the bench steps for the star camera and the horizon cameras with scripted cameras.

The frames have known levels, noises and point sources. The limits of the diagnosis are tested with values
below and above each limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flight.schema.devices import Camera, WideCamera
from ground.bringup import cameras
from ground.bringup.bench import Outcome, Session, StepSkipped
from ground.bringup.cameras import psf_width, step_dark, step_focus, step_light, step_wide
from hal.interfaces.errors import NotResponding
from knightcube.astro.arrays import Image
from tests.support.bench_session import ScriptedCamera, bench_session, named

SIZE = 128
CAMERA = Camera(columns=SIZE, rows=SIZE, bits=12, gain=2.0, read_noise=8.0, exposure=0.5)
"""A camera whose read noise of 8 e- equals 4 counts."""


def noisy(level: float = 100.0, sigma: float = 4.0, seed: int = 1) -> Image:
    """Return a frame with white noise."""
    values = np.random.default_rng(seed).normal(level, sigma, (SIZE, SIZE))
    return np.clip(np.rint(values), 0, 65535).astype(np.uint16)


def starry(count: int, width: float = 1.2, seed: int = 1, peak: float = 1500.0) -> Image:
    """Return a frame with `count` Gaussian stars of a standard deviation (px) on a grid."""
    pixels = noisy(seed=seed).astype(float)
    rows, columns = np.indices(pixels.shape)
    for number in range(count):
        y, x = 20.3 + 30.0 * (number // 4), 20.6 + 29.0 * (number % 4)
        pixels += peak * np.exp(-0.5 * ((rows - y) ** 2 + (columns - x) ** 2) / width**2)
    return np.asarray(np.rint(pixels), dtype=np.uint16)


def bench(
    *pictures: Any, camera: Camera = CAMERA, dark: Outcome | None = None
) -> tuple[Session, ScriptedCamera]:
    """Return a session with a camera that takes the pictures."""
    device = ScriptedCamera(lambda: session, *pictures)
    session = bench_session({"camera": device}, camera=camera)
    if dark is not None:
        session.known["dark"] = dark
    return session, device


def dark(change: Callable[[Image], Image] = lambda pixels: pixels, **values: Any) -> tuple[Image, ...]:
    """Return three dark frames with different noise, to each of which `change` is applied."""
    return tuple(change(noisy(seed=seed, **values)) for seed in (1, 2, 3))


class CoverHand:
    """Emulated hand that records each covering (True) or uncovering (False) of a lens."""

    def __init__(self) -> None:
        self.done: list[tuple[bool, int]] = []

    def cover(self, on: bool, number: int = 0) -> None:
        self.done.append((on, number))

    @property
    def covered(self) -> set[int]:
        """Numbers of the covered lenses."""
        last = {number: on for on, number in self.done}
        return {number for number, on in last.items() if on}


# Dark frames.


def test_dark_frames_give_level_noise_and_read_noise() -> None:
    session, device = bench(*dark())
    session.hand = CoverHand()
    found = step_dark(session)
    assert found.findings == []
    assert found.values["level"] == 100.0
    assert found.values["noise_counts"] == pytest.approx(4.0, rel=0.05)
    assert found.values["read_noise"] == pytest.approx(2.0 * found.values["noise_counts"])
    assert (found.values["hot_pixels"], found.values["sources"]) == (0.0, 0)
    assert found.changes == {"camera": {"read_noise": round(found.values["read_noise"], 2)}}
    assert np.array_equal(found.frames["dark"], noisy(seed=3))
    assert device.triggers == [500_000_000] * 3
    assert session.hand.done == [(True, 0), (False, 0)]


def _hot(share: float, *, pairs: bool = False) -> Callable[[Image], Image]:
    """Return a change that makes a fraction of the pixels hot: single pixels, or pairs in a row."""

    def change(pixels: Image) -> Image:
        places = np.random.default_rng(7).random(pixels.shape) < share
        places[:, 1::2] = False
        if pairs:
            places[:, 1:] |= places[:, :-1]
        return np.where(places, 1000, pixels).astype(np.uint16)

    return change


def _lines(pixels: Image) -> Image:
    """Return a frame of which two rows and three columns are constant."""
    pixels[[10, 50]] = 100
    pixels[:, [3, 4, 90]] = 101
    return pixels


@pytest.mark.parametrize(
    ("frames", "kinds", "says"),
    [
        (dark(sigma=14.0), [], ""),
        (dark(sigma=15.1), ["noisy"], "e-, configured 8"),
        (dark(sigma=2.0), [], ""),
        (dark(sigma=1.0), ["wrong gain"], "e-, configured 8"),
        (dark(lambda pixels: pixels * 0 + 100), ["no signal"], "all frames are equal (100 counts)"),
        (dark(lambda pixels: pixels * 0), [], ""),
        (dark(_lines), ["dead lines"], "2 rows and 3 columns do not change"),
        (dark(_hot(0.0016)), [], ""),
        (dark(_hot(0.01)), ["hot pixels"], " % of the pixels are hot"),
        (dark(lambda pixels: pixels + 3550), [], ""),
        (dark(lambda pixels: pixels + 3620), ["lens cap off"], "0 point sources and 3720 counts"),
        ((noisy(), starry(4, seed=2), starry(4, seed=3)), [], ""),
        ((noisy(), starry(5, seed=2), starry(5, seed=3)), ["lens cap off"], "5 point sources and 100 counts"),
        (dark(lambda pixels: pixels << 1), ["wrong pixel format"], "all pixels are multiples of 2 counts"),
        ((noisy(), noisy(seed=2), starry(1, seed=3, peak=4500.0)), ["wrong pixel format"],
         "but 12 bits permit 4095"),
    ],
)  # fmt: skip
def test_a_fault_in_dark_frames_is_named(frames: tuple[Image, ...], kinds: list[str], says: str) -> None:
    found = step_dark(bench(*frames)[0])
    assert named(found.findings) == [f"camera {kind}" for kind in kinds]
    assert all(says in one.text for one in found.findings)
    assert bool(found.changes) == (not kinds and found.values["noise_counts"] > 0.0)


def test_bright_pairs_are_not_hot_pixels_but_neighbours_are_counted() -> None:
    single, pairs = (step_dark(bench(*dark(_hot(0.01, pairs=value)))[0]) for value in (False, True))
    assert pairs.values["hot_pixels"] == pytest.approx(2.0 * single.values["hot_pixels"])
    assert named(single.findings) == ["camera hot pixels"]
    assert "camera hot pixels" not in named(pairs.findings)


def test_noise_below_one_count_is_measured_from_the_few_differences() -> None:
    """A tenth of the pixels of each frame is one count higher, so the variance of a frame is 0.1 * 0.9."""

    def frame(seed: int) -> Image:
        return (100 + (np.random.default_rng(seed).random((SIZE, SIZE)) < 0.1)).astype(np.uint16)

    camera = Camera(columns=SIZE, rows=SIZE, bits=12, gain=2.0, read_noise=0.6)
    found = step_dark(bench(frame(1), frame(2), frame(3), camera=camera)[0])
    assert found.values["noise_counts"] == pytest.approx(math.sqrt(0.1 * 0.9), rel=0.05)
    assert found.findings == []


def test_a_single_dark_frame_shows_only_that_the_camera_is_intermittent() -> None:
    with pytest.raises(StepSkipped, match="camera delivers only one frame") as ended:
        step_dark(bench(noisy(), None, None, None, None)[0])
    assert ended.value.finding is not None
    assert ended.value.finding.kind == "intermittent"


def test_a_repeated_frame_number_is_a_frozen_camera() -> None:
    session, device = bench(*dark())
    device.frozen = True
    (found,) = step_dark(session).findings
    assert found.line() == "camera: frozen: frame 7 arrives again: switch the camera off and on"


# First light.


def test_the_first_light_states_sources_level_and_saturation() -> None:
    pixels = starry(6)
    pixels[100:110, 100:110] = 4095
    found = step_light(bench(noisy(), pixels)[0])
    assert found.findings == []
    assert found.values["level"] == float(np.median(pixels))
    assert found.values["saturated"] == pytest.approx(100 / SIZE**2)
    assert found.values["sequence"] == 2
    assert found.values["sources"] >= 6
    assert np.array_equal(found.frames["light"], pixels)


def _saturated(rows: int, value: int) -> Image:
    pixels = starry(8)
    pixels[:rows] = value
    return pixels


DARK = Outcome(values={"level": 100.0, "noise_counts": 4.0})


@pytest.mark.parametrize(
    ("pixels", "known", "expected"),
    [
        (starry(5), {}, None),
        (starry(4), {}, ("lens cap on", "4 point sources; the level is that of a dark frame (100 counts)")),
        (starry(4), {"dark": DARK}, ("lens cap on", "4 point sources")),
        (noisy(111.0), {"dark": DARK}, ("lens cap on", "(111 counts)")),
        (noisy(114.0), {"dark": DARK}, ("no sources", "0 point sources at a level of 114 counts")),
        (noisy(86.0), {"dark": DARK}, ("no sources", "level of 86 counts")),
        (noisy(102.0), {"dark": Outcome(values={"level": 100.0, "noise_counts": 0.0})}, ("lens cap on", "")),
        (noisy(104.0), {"dark": Outcome(values={"level": 100.0, "noise_counts": 0.0})}, ("no sources", "")),
        (noisy(104.0), {"dark": Outcome()}, ("no sources", "")),
        (np.full((SIZE, SIZE), 300, np.uint16), {}, ("no signal", "every pixel has 300 counts")),
        (np.zeros((SIZE, SIZE), np.uint16), {}, ("lens cap on", "(0 counts)")),
        (_saturated(25, 4095), {}, ("lens cap on", "0 point sources")),
        (_saturated(27, 4095), {}, ("too bright", "21 % of the pixels are saturated")),
        (_saturated(27, 4000), {}, ("lens cap on", "0 point sources")),
        (_saturated(27, 4096), {}, ("wrong pixel format", "up to 4096 counts, but 12 bits permit 4095")),
        (starry(8)[:, :120], {}, ("wrong size", "120 x 128 pixels instead of 128 x 128")),
    ],
)
def test_a_fault_of_the_first_light_is_named(
    pixels: Image, known: dict[str, Outcome], expected: tuple[str, str] | None
) -> None:
    found = step_light(bench(noisy(), pixels, dark=known.get("dark"))[0]).findings
    assert named(found) == ([] if expected is None else [f"camera {expected[0]}"])
    assert all(expected is not None and expected[1] in one.text for one in found)


def test_frames_of_another_size_correct_the_configured_size() -> None:
    found = step_light(bench(noisy(), starry(8)[:, :120])[0])
    assert found.changes == {"camera": {"columns": 120, "rows": SIZE}}
    assert step_light(bench(noisy(), starry(8))[0]).changes == {}


def test_the_configured_saturation_is_used() -> None:
    camera = Camera(columns=SIZE, rows=SIZE, bits=12, saturation=3000.0)
    found = step_light(bench(noisy(), _saturated(40, 3000), camera=camera)[0])
    assert named(found.findings) == ["camera too bright"]
    assert found.values["saturated"] >= 40 / SIZE


# Focus.


@pytest.mark.parametrize(("width", "factor"), [(1.0, 1), (1.6, 1), (5.0, 4)])
def test_the_psf_width_is_that_of_the_stars(width: float, factor: int) -> None:
    """Wide stars are stars of 1.25 px in a frame that is enlarged by a factor."""
    pixels = np.kron(starry(12, width / factor, peak=2000.0), np.ones((factor, factor), np.uint16))
    measured, count = psf_width(pixels)
    assert measured == pytest.approx(width, rel=0.08)
    assert count == 12


def test_the_psf_width_of_8_bit_frames_is_that_of_16_bits() -> None:
    pixels = np.minimum(starry(12), 255)
    assert psf_width(pixels.astype(np.uint8)) == psf_width(pixels)


def test_four_stars_have_no_psf_width() -> None:
    measured, count = psf_width(starry(4))
    assert math.isnan(measured)
    assert count == 4
    assert math.isfinite(psf_width(starry(5))[0])


def widths(monkeypatch: pytest.MonkeyPatch, *values: float) -> tuple[Session, ScriptedCamera]:
    """Return a session whose n-th frame has the n-th PSF width and the level n."""
    pictures = [np.full((SIZE, SIZE), number, np.uint16) for number in range(len(values))]
    monkeypatch.setattr(cameras, "psf_width", lambda pixels: (values[int(pixels[0, 0])], 9))
    return bench(*pictures)


@pytest.mark.parametrize(
    ("values", "kept", "best", "fault"),
    [
        ((3.0, 0.8, 1.2), 1.2, 1, False),
        ((0.8, 0.8, 0.8), 0.8, 2, False),
        ((1.5, math.nan, math.nan), 1.5, 0, False),
        ((1.0, 1.0, 2.45), 2.45, 1, False),
        ((1.0, 1.0, 2.55), 2.55, 1, True),
        ((1.0, 1.0, 0.61), 0.61, 2, False),
        ((1.0, 1.0, 0.59), 0.59, 2, True),
    ],
)
def test_the_last_width_counts_and_the_sharpest_frame_is_shown(
    values: tuple[float, ...], kept: float, best: int, fault: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, device = widths(monkeypatch, *values)
    found = step_focus(session)
    assert named(found.findings) == (["camera out of focus"] if fault else [])
    assert found.changes == ({} if fault else {"camera": {"psf_sigma": kept}})
    assert found.values["psf_sigma"] == kept
    assert found.values["widths"] == [None if math.isnan(one) else one for one in values]
    assert found.arrays["widths"] == pytest.approx(np.array(values), nan_ok=True)
    assert found.frames["focus"][0, 0] == best
    assert len(device.triggers) == 3


def test_the_operator_ends_the_focusing(monkeypatch: pytest.MonkeyPatch) -> None:
    session, device = widths(monkeypatch, 4.0, 3.0, 2.0, 1.0, 1.5)
    shown: list[str] = []

    def live(text: str) -> bool:
        shown.append(text)
        return len(shown) < 5

    session.live = live
    assert step_focus(session).values["widths"] == [4.0, 3.0, 2.0, 1.0, 1.5]
    assert shown[3] == "PSF width 1.00 px, 9 sources"
    assert len(device.triggers) == 5


def test_frames_without_stars_skip_the_focusing(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StepSkipped, match="fewer than 5 stars in each frame"):
        step_focus(widths(monkeypatch, math.nan, math.nan, math.nan)[0])


# Horizon cameras.

WIDE = WideCamera(columns=64, rows=64, bits=8)


class LitCameras:
    """Horizon cameras with given pixel levels of lit and covered lenses, and possibly exchanged plugs."""

    def __init__(
        self, levels: list[tuple[float, float]], lens: list[int] | None = None, leak: float = 0.0
    ) -> None:
        self.levels, self.lens, self.leak = levels, lens or list(range(len(levels))), leak
        self.hand = CoverHand()
        keys = [f"wide_cameras[{number}]" for number in range(len(levels))]
        self.session = bench_session({}, wide_cameras=(WIDE,) * len(levels))
        self.session.hand = self.hand
        for number, key in enumerate(keys):
            device = _Wide(self, number)
            self.session._open[key] = device

    def pixels(self, number: int) -> Image:
        lit, covered = self.levels[number]
        others = len(self.hand.covered - {1 + self.lens[number]})
        level = (
            covered
            if 1 + self.lens[number] in self.hand.covered
            else lit - self.leak * others * (lit - covered)
        )
        rows = np.indices((WIDE.rows, WIDE.columns))[0]
        return np.asarray(np.rint(np.clip(level + rows % 2, 0, 255)), dtype=np.uint8)


class _Wide(ScriptedCamera):
    """Horizon camera whose frames have the level of its lens, lit or covered."""

    def __init__(self, lit: LitCameras, number: int) -> None:
        super().__init__(lambda: lit.session)
        self.lit, self.number = lit, number

    def poll(self) -> Any:
        self.pictures = [self.lit.pixels(self.number)]
        return super().poll()


def test_a_cover_darkens_only_its_own_horizon_camera() -> None:
    lit = LitCameras([(120.0, 10.0), (60.0, 5.0), (90.0, 8.0)])
    found = step_wide(lit.session)
    keys = [f"wide_cameras[{number}]" for number in range(3)]
    assert found.findings == []
    assert found.values["levels"] == dict(zip(keys, [120.5, 60.5, 90.5], strict=True))
    assert found.values["darkened"] == {key: [key] for key in keys}
    assert lit.hand.done == [(on, number) for number in (1, 2, 3) for on in (True, False)]


@pytest.mark.parametrize(
    ("levels", "lens", "leak", "expected", "says"),
    [
        ([(120.0, 10.0), (60.0, 5.0)], [1, 0], 0.0, ["[0] exchanged", "[1] exchanged"],
         "its cover darkens wide_cameras["),
        ([(120.0, 10.0), (60.0, 60.0)], None, 0.0, ["[1] lens cap on"], "its lens is covered (60 counts)"),
        ([(111.0, 100.0), (60.0, 5.0)], None, 0.0, [], ""),
        ([(110.0, 100.0), (60.0, 5.0)], None, 0.0, ["[0] lens cap on"], "(100 counts)"),
        ([(6.0, 5.0), (60.0, 5.0)], None, 0.0, [], ""),
        ([(7.0, 5.0), (60.0, 5.0)], None, 0.0, [], ""),
        ([(120.0, 10.0), (60.0, 5.0)], None, 0.45, [], ""),
        ([(254.0, 10.0), (60.0, 5.0)], None, 0.0, [], ""),
        ([(255.0, 10.0), (60.0, 5.0)], None, 0.0, ["[0] too bright"], "100 % of the pixels are saturated"),
    ],
)  # fmt: skip
def test_a_fault_of_a_horizon_camera_is_named(
    levels: list[tuple[float, float]], lens: list[int] | None, leak: float, expected: list[str], says: str
) -> None:
    found = step_wide(LitCameras(levels, lens, leak).session)
    assert named(found.findings) == [f"wide_cameras{one}" for one in expected]
    assert all(says in one.text for one in found.findings)
    bright = {one.part for one in found.findings if one.kind == "too bright"}
    assert set(found.values["levels"]) == {f"wide_cameras[{n}]" for n in range(len(levels))} - bright


def test_a_horizon_camera_that_fails_while_it_is_covered_hides_no_other_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lit = LitCameras([(60.0, 60.0), (120.0, 10.0), (90.0, 8.0)])
    pixels = lit.pixels

    def taken(number: int) -> Image:
        if number == 1 and 2 in lit.hand.covered:
            raise NotResponding("camera", "the plug is loose")
        return pixels(number)

    monkeypatch.setattr(lit, "pixels", taken)
    found = step_wide(lit.session)
    assert named(found.findings) == ["wide_cameras[1] no frame", "wide_cameras[0] lens cap on"]
    assert set(found.values["darkened"]) == {"wide_cameras[0]", "wide_cameras[2]"}
    assert lit.hand.covered == set()


def test_a_configuration_without_horizon_cameras_skips_the_step() -> None:
    with pytest.raises(StepSkipped, match="no section `wide_cameras`"):
        step_wide(bench_session({}, wide_cameras=()))
