"""Tests of star camera frames: repeated rows of an earlier frame, lack of stars, and mid-exposure time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link import events
from flight.link.telemetry.definitions import STARS
from flight.loop.imaging import FrameReport, RepeatedRows, is_strange, middle_ns
from hal.interfaces.devices import Frame
from knightcube.astro.arrays import Image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.solve import FrameSolution, SolveStatus
from knightcube.vision.startracker.survey import FrameKind

RNG = np.random.default_rng(8)


def exposed(noise: float = 10.0, dtype: str = "uint16") -> Image:
    """Return a frame of the sky background with read noise, in counts."""
    sky = RNG.poisson(20.0, (240, 320)) + RNG.normal(0.0, noise, (240, 320)) + 100.0
    return np.clip(sky, 0, np.iinfo(dtype).max).astype(dtype)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_frames_of_a_working_camera_are_not_torn(dtype: str) -> None:
    rows = RepeatedRows()
    assert [rows.count(exposed(dtype=dtype)) for _ in range(50)] == [0] * 50


@pytest.mark.parametrize("at", [10, 120, 235])
def test_a_frame_with_the_rows_of_an_earlier_one_is_torn(at: int) -> None:
    rows = RepeatedRows()
    before, between, now = exposed(), exposed(), exposed()
    rows.count(before)
    rows.count(between)
    assert rows.count(np.concatenate([now[:at], before[at:]])) == pytest.approx(
        32 * (240 - at) / 240, abs=1.5
    )
    assert rows.count(exposed()) == 0


def test_the_same_frame_again_is_not_torn_but_frozen() -> None:
    rows, frame = RepeatedRows(), exposed()
    rows.count(frame)
    assert rows.count(frame) == 0


def test_rows_without_noise_do_not_count_as_repeated() -> None:
    """Rows without noise are not counted as repeated.

    A dark 8-bit sensor gives rows of zeros and constant hot pixels.
    """
    rows = RepeatedRows()
    for number in range(4):
        frame = np.zeros((240, 320), dtype=np.uint8)
        frame[:, 40] = 255
        frame[200, 100 + number] = 60
        assert rows.count(frame) == 0


@pytest.mark.parametrize(
    ("status", "stars", "strange"),
    [
        (SolveStatus.NO_MATCH, 12, True),
        (SolveStatus.NO_MATCH, 11, False),
        (SolveStatus.SOLVED, 40, False),
        (SolveStatus.AMBIGUOUS, 40, False),
    ],
)
def test_only_a_frame_of_many_stars_without_a_match_gives_the_event_camera_strange(
    status: SolveStatus, stars: int, strange: bool
) -> None:
    camera = Pinhole(320, 240, 400.0)
    solution = FrameSolution(status, "", FrameKind.POINTS, camera, points=np.zeros((stars, 2)))
    assert is_strange(solution) is strange
    assert not is_strange(None)


@pytest.mark.parametrize(("start_ns", "exposure_ns", "middle"), [(100, 10, 105), (100, 11, 105), (0, 0, 0)])
def test_mid_exposure_is_half_an_exposure_after_its_start(
    start_ns: int, exposure_ns: int, middle: int
) -> None:
    assert middle_ns(Frame(1, start_ns, exposure_ns, start_ns, exposed())) == middle


@pytest.mark.parametrize(
    ("status", "accepted", "reported"),
    [
        (SolveStatus.NO_MATCH, None, [events.CAMERA_STRANGE]),
        (SolveStatus.AMBIGUOUS, None, []),
        (SolveStatus.SOLVED, False, [events.STARS_REFUSED]),
        (SolveStatus.SOLVED, True, []),
    ],
)
def test_strange_stars_and_a_refused_attitude_are_reported_and_every_solution_is_recorded(
    status: SolveStatus, accepted: bool | None, reported: list[Any]
) -> None:
    said: list[Any] = []
    kept: list[tuple[Any, dict[str, Any]]] = []
    recorder = SimpleNamespace(
        epoch_ns=5, record=lambda packet, _now, **values: kept.append((packet, values))
    )
    log = SimpleNamespace(report=lambda kind, _now, _text: said.append(kind))
    services = cast(Any, SimpleNamespace(recorder=recorder, events=log))
    solution = FrameSolution(
        status, "", FrameKind.POINTS, Pinhole(320, 240, 400.0), points=np.zeros((14, 2)), star=np.full(14, -1)
    )
    frame = Frame(7, 100, 10, 100, exposed())
    FrameReport(cast(Any, None), cast(Any, None), services).stars(frame, solution, None, 200, accepted)
    assert said == reported
    ((packet, values),) = kept
    assert packet is STARS
    assert (values["sequence"], values["middle_ns"], values["found"]) == (7, 100, 14)
    assert values["accepted"] == int(accepted is True)
    assert np.isnan(values["quaternion"]).all()
