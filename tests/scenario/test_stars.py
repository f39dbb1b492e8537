"""Tests of star attitudes in flight from the real sky, with and without a known pointing direction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.bodies import as_testbed
from flight.schema.devices import CameraAccuracy, CameraLens
from knightcube.astro.quaternion import from_rotation_vector, multiply
from sim_hal.emulators.serial_line import SOUND, LineFaults
from tests.support.attitude_errors import assert_solved, star_errors
from tests.support.flights import TEXT, Rigged, demo_config, demo_world, event_names, fly

_LOST, _TRACKED = 0, 1


def unit_silent(rigged: Rigged, begin: float, end: float) -> None:
    """Make the IMU silent between two mission times (s), by default during the whole run."""
    wire = rigged.lock.line.to_host

    def silence() -> None:
        wire.faults = LineFaults(silent=True)

    def speak() -> None:
        wire.faults = SOUND

    if begin <= 0.0:
        silence()
    else:
        rigged.at(begin, silence)
    rigged.at(end, speak)


def test_a_flight_without_an_estimate_identifies_the_stars_lost_in_space(tmp_path: Path) -> None:
    """A flight without an estimate identifies the stars lost in space and starts the filter.

    While the IMU is silent, the filter has no estimate, so it neither predicts nor uses an attitude.
    """
    run = fly(demo_config(8.0), tmp_path, lambda rigged: unit_silent(rigged, 0.0, 4.0))
    assert_solved(run)
    assert run["stars"]["tracked"].tolist() == [_LOST, _TRACKED]
    assert run["stars"]["accepted"].tolist() == [0, 1]


def test_after_a_blackout_the_first_frame_is_solved_lost_in_space_and_the_next_by_tracking(
    tmp_path: Path,
) -> None:
    """After ten seconds without frames and IMU, the first frame is solved lost in space.

    The next frame is solved by tracking. The filter's model cannot predict the attitude of the camera. The
    body has swung freely, and the full torque of the coil then rotates the body back. The IMU resumes early
    enough that the rate changes by less than half in the next exposure of one second. The motion fit does not
    permit a change by more than half within an exposure.
    """

    def prepare(rigged: Rigged) -> None:
        unit_silent(rigged, 4.0, 16.5)
        camera = rigged.lock.hardware.camera
        rigged.at(4.0, lambda: setattr(camera, "fault", "black"))
        rigged.at(14.0, lambda: setattr(camera, "fault", ""))

    run = fly(demo_config(23.0), tmp_path, prepare)
    names = event_names(run)
    assert names.index("camera-black") < names.index("control-regained")
    assert_solved(run)
    stars = run["stars"]
    assert stars["sequence"].tolist() == [1, 4, 5], "black frames show no stars"
    assert stars["tracked"].tolist() == [_TRACKED, _LOST, _TRACKED]
    assert stars["accepted"][-1]


def test_star_attitudes_of_a_displaced_camera_are_refused_and_reported(tmp_path: Path) -> None:
    """If the camera is displaced, its star attitudes are refused and reported.

    The stars are then identified in a direction that contradicts the estimate.
    """

    def knock(rigged: Rigged) -> None:
        camera = rigged.lock.hardware.camera
        assert camera is not None
        off = from_rotation_vector(np.radians([0.0, 3.0, 0.0]))
        camera._mounting = multiply(off, camera._mounting)

    run = fly(demo_config(18.0), tmp_path, lambda rigged: rigged.at(8.0, lambda: knock(rigged)))
    stars = run["stars"]
    assert set(stars["status"].tolist()) == {b"solved"}
    assert stars["accepted"].tolist() == [1, 1, 0, 0]
    assert stars["tracked"].tolist() == [_TRACKED, _TRACKED, _LOST, _LOST]
    error, _ = star_errors(run)
    assert np.degrees(error[2:, 1]) == pytest.approx([3.0, 3.0], abs=0.01)
    assert event_names(run).count("stars-refused") == 2
    angle = 2.0 * np.arcsin(run["truth"]["quaternion"][-1, 1])
    assert run["control"]["angle"][-1] == pytest.approx(angle, abs=np.radians(0.2))


def test_the_thesis_s_corner_detectors_fly_with_the_stars_too(tmp_path: Path) -> None:
    config = demo_config(13.0)
    assert config.camera is not None
    camera = configuration.replace(config.camera, estimator="harris")
    run = fly(configuration.replace(config, camera=camera), tmp_path)
    assert_solved(run)
    assert run["stars"]["accepted"].all()
    assert run["streak"]["status"].tolist() == [b"rate", b"rate", b"too-short"]
    assert run["streak"]["accepted"].tolist() == [1, 1, 0]
    assert event_names(run) == ["started", "target", "stopped"]


def test_a_distorted_lens_that_the_configuration_describes_is_corrected(tmp_path: Path) -> None:
    """The simulated camera has a lens whose distortion moves the image corner by 4 %."""
    text = TEXT.replace(
        "  accuracy: {centre: 0.0, distortion: 0.0}",
        "  lens: {focal_length: 2900.0, centre: [518.0, 505.0], k1: 0.6}\n"
        "  accuracy: {focal_length: 0.0001, centre: 0.1, distortion: 0.0002}",
    )
    config = as_testbed(configuration.parse(text))
    run = fly(configuration.replace(config, duration=13.0, steps=config.steps[:1]), tmp_path)
    assert_solved(run)
    assert run["stars"]["accepted"].all()
    error, _ = star_errors(run)
    # The coil's torque about y changes within an exposure; the body does not rotate about the other axes.
    assert np.abs(error[:, [0, 2]]).max() < 0.15 / 2900.0
    streaks = run["streak"][run["streak"]["status"] == b"rate"]
    assert len(streaks) == 2
    assert streaks["accepted"].all()


def test_a_lens_unlike_its_description_is_learned_and_does_not_bias_the_attitude(tmp_path: Path) -> None:
    """The true lens differs by one standard deviation in focal length, optical axis and distortion.

    The configured mounting holds for the pixel on the configured optical axis, although the true axis is
    elsewhere.
    """
    config, world = demo_config(43.0), demo_world()
    assert config.camera is not None
    accuracy = CameraAccuracy(focal_length=0.001)
    camera = configuration.replace(config.camera, accuracy=accuracy)
    config = configuration.replace(config, camera=camera, steps=config.steps[:1])
    lens = CameraLens(focal_length=2906.6, centre=(513.5, 509.5), k1=0.08)
    section = configuration.replace(world, sky=configuration.replace(world.sky, lens=lens))
    run = fly(config, tmp_path, section=section)
    assert_solved(run)
    assert run["stars"]["accepted"].all()
    error, covariance = star_errors(run)
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert np.mean(squares) < 6.0
    assert np.abs(error[-3:]).max() < 0.2 / 2906.6
    learned = run["lens"][-1]
    assert learned["focal_length"] == pytest.approx(2906.6, abs=0.3)
    assert learned["centre"] == pytest.approx([513.5, 509.5], abs=0.5)
