"""Tests that frames during a slew have suitable streak lengths, and that no coil switches during a frame."""

from __future__ import annotations

import numpy as np
import pytest

from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.devices import camera_model
from ground.telemetry import Run
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.quaternion import attitude_matrix
from tests.support import slew_frames
from tests.support.flights import fly

DURATION, BEGIN = 85.0, 6.0
"""Duration (s) of the run, which ends while the body still accelerates."""
SEED = 3
ABOUT = np.array([1.0, 0.0, 0.0])
"""Body axis of the slew: across the boresight, which is along -y."""
STREAKS = 1.1
"""Star motion (px), during the default exposure, above which a frame must contain streaks."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return the first 85 s of a slew of a 3U, with a frame every 5 s."""
    config, world = slew_frames.flight("orbit", SEED, ABOUT)
    first, second = config.targets
    config = configuration.replace(
        config,
        duration=DURATION,
        wide_cameras=(),
        targets=(first, configuration.replace(second, at=BEGIN)),
    )
    return fly(config, tmp_path_factory.mktemp("slew"), section=world)


def _streaked(run: Run) -> tuple[BoolArray, FloatArray]:
    """Return whether each frame must contain streaks (n,), and the true star motion (n,), px."""
    config, _ = slew_frames.flight("orbit", SEED, ABOUT)
    assert config.camera is not None
    to_camera = attitude_matrix(np.array(config.camera.mounting))
    frames, truth = run["streak"], run["truth"]
    middle = frames["exposure_start_ns"] + 0.5e9 * frames["exposure"]
    rates = [np.interp(middle, truth["time_ns"], part) for part in truth["rate"].T.astype(float)]
    speed = np.hypot(*(to_camera @ np.array(rates))[:2]) * camera_model(config.camera).focal_length
    return np.asarray(speed * config.camera.exposure > STREAKS), np.asarray(speed * frames["exposure"])


def test_streaks_of_a_slew_are_long_enough_to_tell_the_rate_and_no_longer(flown: Run) -> None:
    """The streaks of a slew are 5 to 100 px long. Frames with point-like stars keep the usual exposure."""
    streaked, moved = _streaked(flown)
    exposure = flown["streak"]["exposure"]
    assert streaked.sum() >= 8
    assert np.all((moved[streaked] > 5.0) & (moved[streaked] < 100.0))
    assert np.all((exposure >= 0.1 - 1e-6) & (exposure <= 1.0 + 1e-6))
    assert np.all(exposure[moved < 1.0] == pytest.approx(0.2))
    assert "camera: slow" not in " ".join(to_text(text) for text in flown["event"]["text"])


def test_no_coil_switches_during_an_exposure_of_a_slew(flown: Run) -> None:
    packets = flown["attitude"]
    changed = np.abs(np.diff(packets["dipole"], axis=0)).max(axis=1) > 0.0
    # First packets after changes of the commanded dipole.
    after = packets["time_ns"].astype(np.int64)[1:][changed]
    frames = flown["streak"][flown["streak"]["exposure_start_ns"] > (BEGIN + 2.0) * 1e9]
    assert len(after) > 30
    for frame in frames:
        begin = int(frame["exposure_start_ns"])
        end = begin + round(float(frame["exposure"]) * 1e9)
        # If an exposure ends at a change of the dipole, the packet of this instant has the new dipole.
        assert not ((after - 100_000_000 >= begin) & (after < end)).any()


def test_rates_and_attitudes_of_frames_during_a_slew_enter_the_estimate(flown: Run) -> None:
    streaked, _ = _streaked(flown)
    frames, stars = flown["streak"][streaked], flown["stars"]
    # Of ten crowded frames with streaks of 7 to 8 px, one or two give no rate, because overlapping streaks do
    # not have a common motion.
    assert np.mean([to_text(status) == "rate" for status in frames["status"]]) >= 0.8
    assert np.all(frames["accepted"][[to_text(status) == "rate" for status in frames["status"]]] == 1)
    of_streaks = np.isin(stars["sequence"], frames["sequence"])
    assert np.mean(stars["accepted"][of_streaks]) > 0.8
    _, rated, used, nees = slew_frames.compared(flown, BEGIN + 5.0, DURATION)
    assert rated == used
    assert nees.mean() < 2.0
    assert nees.max() < 6.0
