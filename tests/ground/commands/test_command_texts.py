"""Tests of the output of `knightcube camera` and `knightcube rate` for artificial frames and motions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.schema.devices import Camera
from ground.commands import camera, rate
from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding
from knightcube.vision.streaks.streak_result import REASONS, FrameMotion, StreakStatus
from tests.manual_clock import ManualClock

PIXELS = np.array([[10, 20, 30], [40, 255, 255]], dtype=np.uint8)
FRAME = Frame(7, 1_000_000_000, 200_000_000, 1_250_000_000, PIXELS)


def test_a_frame_has_its_times_and_counts() -> None:
    fact = camera._facts(FRAME, Camera(bits=8))
    assert fact == {
        "sequence": 7, "age_s": pytest.approx(0.25), "latency_s": pytest.approx(0.05),
        "exposure_s": pytest.approx(0.2), "columns": 3, "rows": 2, "minimum": 10, "median": 35.0,
        "maximum": 255, "saturated": pytest.approx(2 / 6),
    }  # fmt: skip
    assert camera._line(fact) == (
        "frame 7: 3 x 2, exposed 0.2000 s, 50.0 ms after its end, age 0.250 s, "
        "counts 10 / 35 / 255 (minimum, median, maximum), saturated 33.33%\n"
    )
    assert camera._facts(FRAME, Camera(bits=8, saturation=40.0))["saturated"] == pytest.approx(3 / 6)
    assert camera._facts(FRAME, Camera(bits=12))["saturated"] == 0.0


class Source:
    """A camera whose frame arrives after a given number of polls."""

    def __init__(self, clock: ManualClock, polls: int) -> None:
        self.clock, self.polls, self.triggers = clock, polls, list[int]()

    def trigger(self, exposure_ns: int) -> None:
        """Start an exposure."""
        self.triggers.append(exposure_ns)
        self.left = self.polls

    def poll(self) -> Frame | None:
        """Return the frame after the given number of polls."""
        self.left -= 1
        return None if self.left >= 0 else FRAME

    def close(self) -> None:
        """Do nothing."""


def test_frames_are_triggered_one_by_one() -> None:
    clock = ManualClock()
    begun_ns, source = clock.now_ns(), Source(clock, 3)
    assert len(list(camera._frames(clock, source, 100, 2))) == 2
    assert source.triggers == [100, 100]
    assert clock.now_ns() - begun_ns == 2 * 3 * 5_000_000


@pytest.mark.parametrize(("polls", "comes"), [(2161, True), (2162, False)])
def test_a_frame_is_awaited_for_eight_exposures_and_ten_seconds(polls: int, comes: bool) -> None:
    """The timeout of a frame is eight exposures plus ten seconds.

    For an exposure of 0.1 s, the timeout of 10.8 s is 2160 polls at intervals of 5 ms.
    """
    clock = ManualClock()
    frames = camera._frames(clock, Source(clock, polls), 100_000_000, 1)
    if comes:
        assert next(frames) is FRAME
        return
    with pytest.raises(NotResponding, match="no frame came"):
        next(frames)


@pytest.mark.parametrize(("count", "name"), [(1, "sky.png"), (2, "sky-7.png")])
def test_several_frames_are_named_by_their_numbers(tmp_path: Path, count: int, name: str) -> None:
    path = camera._keep(tmp_path / "sky.png", FRAME, count)
    assert path == tmp_path / name
    assert path.exists()


def motion(**changes: Any) -> FrameMotion:
    """Return a motion that was estimated from one of two streaks."""
    ends = np.array([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 8.0]]])
    known = {
        "rate": np.array([3e-3, 0.0, 4e-3]), "covariance": np.diag([1e-8, 4e-8, 1e-8]), "length": 12.34,
        "endpoints": ends, "used": np.array([True, False]), "residual": 1e-5,
    }  # fmt: skip
    return FrameMotion(**{"status": StreakStatus.RATE, "checksum": 1, "exposure": 0.5, **known, **changes})


def test_a_rate_is_printed_in_milliradians_with_its_deviation() -> None:
    assert rate._text(motion(), ()).splitlines() == [
        "status:        rate",
        "rate x, y, z:  +3.0000 +- 0.1000  +0.0000 +- 0.2000  +4.0000 +- 0.1000 mrad/s",
        "magnitude:     5.0000 mrad/s +- 2.000 %",
        "streaks:       2 found, 1 used, 12.3 px long",
    ]


def test_the_text_of_a_rate_states_that_its_sign_is_unknown() -> None:
    text = rate._text(motion(status=StreakStatus.AMBIGUOUS), ())
    assert "direction:     unknown, the rate may have the opposite sign: give --prior\n" in text


@pytest.mark.parametrize("missing", ["rate", "covariance"])
def test_a_motion_without_rate_or_covariance_prints_none(missing: str) -> None:
    changes: dict[str, Any] = {missing: None}
    text = rate._text(motion(**changes), ())
    assert "mrad/s" not in text
    assert rate._facts(motion(**changes), (), "likelihood")["covariance_rad2_s2"] is None


def test_without_a_rate_the_reason_is_printed() -> None:
    none = motion(status=StreakStatus.TOO_FEW, rate=None, covariance=None, length=math.nan, residual=math.nan)
    reason = REASONS[StreakStatus.TOO_FEW]
    status, why, streaks = rate._text(none, ()).splitlines()
    assert (status, streaks) == ("status:        too-few", "streaks:       2 found, 1 used")
    assert why.startswith(f"reason:        {reason}: "), "the remedy follows the reason"
    facts = rate._facts(none, (), "harris")
    assert facts == {
        "method": "harris", "status": "too-few", "reason": reason, "rate_rad_s": None,
        "covariance_rad2_s2": None, "direction_of_time_known": False, "exposure_s": 0.5,
        "streak_length_px": None, "residual_rad": None, "objects": [],
        "streaks": [
            {"start_px": [1.0, 2.0], "end_px": [3.0, 4.0], "used": True},
            {"start_px": [5.0, 6.0], "end_px": [7.0, 8.0], "used": False},
        ],
    }  # fmt: skip


def test_a_rate_has_its_facts_and_no_reason() -> None:
    facts = rate._facts(motion(), (), "likelihood")
    assert (facts["reason"], facts["direction_of_time_known"], facts["residual_rad"]) == ("", True, 1e-5)
    assert facts["rate_rad_s"] == [3e-3, 0.0, 4e-3]
    assert facts["covariance_rad2_s2"] == np.diag([1e-8, 4e-8, 1e-8]).tolist()
    assert facts["streak_length_px"] == 12.34
