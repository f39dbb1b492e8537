"""Tests that after any device fault the body is controlled or the coils are at zero, with a logged event."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flight.loop.flight_loop import FlightProgress
from flight.schema.reader import replace
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.serial_line import SOUND, LineFaults
from sim_hal.settings import FaultEntry
from tests.scenario.mode_flights import released
from tests.support.flights import Rigged, config_for, demo_config, demo_world, event_names, fly

BEGIN, END, DURATION, LONG = 2.0, 5.0, 8.0, 12.0
"""Start and end (s) of a fault, and durations (s) of a short flight and of a flight back to its target."""
AT_TARGET = released(-0.3, 0.0)
"""World in which the body starts at rest at its target; the suspension thread alone would rotate it by 6 deg
in 6 s."""
SHAM = 0.5
"""Start (s) of a camera fault, between the first and the second frame."""
WITHIN = 0.1
"""Longest time (s) from the loss of control until the coils are at zero."""


def true_current(run: Run, since: float, until: float) -> FloatArray:
    """Return the largest coil current at each sample of the truth in an interval."""
    truth = run["truth"]
    time: FloatArray = truth["time_ns"] * 1e-9
    largest: FloatArray = np.abs(truth["current"]).max(axis=1)
    return largest[(time >= since) & (time < until)]


def assert_whole(run: Run, duration: float = DURATION) -> None:
    """Assert that the log contains all written packets, in order, up to the end of the run."""
    for log in run.logs.values():
        assert log.intact
    assert len(run["control"]) == round(duration / 0.025)
    assert run["control"]["time_ns"][-1] == pytest.approx((duration - 0.025) * 1e9)


def line(faults: LineFaults) -> Callable[[Rigged], None]:
    """Return the function that disturbs the serial line of the VN-100 from BEGIN to END."""

    def prepare(rigged: Rigged) -> None:
        wire = rigged.lock.line.to_host
        rigged.at(BEGIN, lambda: setattr(wire, "faults", faults))
        rigged.at(END, lambda: setattr(wire, "faults", SOUND))

    return prepare


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return fly(demo_config(DURATION, camera=False), tmp_path_factory.mktemp("sound"))


def test_a_sound_flight_raises_no_alarm(sound: Run) -> None:
    assert event_names(sound) == ["started", "target", "stopped"]
    assert_whole(sound)
    assert true_current(sound, BEGIN, END).max() > 0.0


@pytest.mark.parametrize(
    ("faults", "events"),
    [
        (LineFaults(silent=True), ["control-lost", "imu-silent", "imu-recovered", "control-regained"]),
        (LineFaults(garbage=True), ["imu-corrupt", "control-lost", "imu-unusable", "control-regained"]),
    ],
    ids=["silence", "garbage"],
)
def test_the_coils_are_off_while_the_line_delivers_no_packets(
    tmp_path: Path, faults: LineFaults, events: list[str]
) -> None:
    run = fly(demo_config(LONG, camera=False), tmp_path, line(faults), section=AT_TARGET)
    names = event_names(run)
    assert [name for name in dict.fromkeys(names) if name in events] == events
    assert true_current(run, BEGIN + WITHIN, END).max() == 0.0
    assert true_current(run, END + 0.3, LONG).max() > 0.0
    assert_whole(run, LONG)
    final = 2 * np.arcsin(run["truth"]["quaternion"][-1, 1]) - 2 * np.arcsin(-0.3)
    assert abs(final) < np.radians(4.5)


def test_after_a_silence_of_a_second_the_estimate_continues_from_its_prediction(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        wire = rigged.lock.line.to_host
        for begin in (4.0, 14.0):
            rigged.at(begin, lambda: setattr(wire, "faults", LineFaults(silent=True)))
            rigged.at(begin + 1.0, lambda: setattr(wire, "faults", SOUND))

    run = fly(demo_config(20.0, camera=False), tmp_path, prepare)
    names = event_names(run)
    assert [names.count(name) for name in ("imu-silent", "control-lost", "control-regained")] == [2, 2, 2]
    assert "imu-refused" not in names, "the first readings agree with what was carried on"
    assert np.isfinite(run["control"]["angle"][1:]).all()
    for begin in (4.0, 14.0):
        assert true_current(run, begin + WITHIN, begin + 1.0).max() == 0.0
    sigma = run["control"]["angle_sigma"]
    assert sigma[round(14.9 / 0.025)] > 1.1 * sigma[round(13.9 / 0.025)], "the covariance widens"
    assert sigma[-1] < 1.1 * sigma[round(13.9 / 0.025)], "and recovers"
    angle = 2 * np.arcsin(run["truth"]["quaternion"][:, 1])
    time = run["truth"]["time_ns"] * 1e-9
    error = np.degrees(np.abs(angle - 2 * np.arcsin(-0.3)))
    assert error[(time > 13.0) & (time < 14.0)].max() < 0.1
    # Without control, the suspension thread would rotate the body by k theta / (2 J) t^2 = 0.17 deg during
    # the fault of one second.
    assert error[time > 14.0].max() < 0.3
    assert error[time > 18.5].max() < 0.1


@pytest.mark.parametrize(
    "faults",
    [LineFaults(cut_probability=0.3), LineFaults(flip_probability=3e-4)],
    ids=["cut packets", "flipped bits"],
)
def test_some_damaged_packets_are_reported_and_do_not_end_control(tmp_path: Path, faults: LineFaults) -> None:
    run = fly(demo_config(DURATION, camera=False), tmp_path, line(faults))
    names = event_names(run)
    assert "imu-corrupt" in names
    assert "task-failed" not in names
    assert_whole(run)
    assert run["housekeeping"]["imu_bad_checksum"][-1] + run["housekeeping"]["imu_discarded_bytes"][-1] > 0
    rate: FloatArray = run["control"]["rate"]
    true: FloatArray = run["truth"]["rate"][: len(rate), 1]
    error = np.abs(rate - true)
    assert np.nanmax(error[40:]) < 0.01, "no corrupt value reached the estimate"


def test_noise_on_an_idle_line_is_corruption_not_silence(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        wire = rigged.lock.line.to_host
        rigged.at(BEGIN, lambda: setattr(wire, "faults", LineFaults(silent=True)))
        for k in range(100):
            # Noise arises on the line itself, so it arrives even if the VN-100's bytes are lost.
            def spark(k: int = k) -> None:
                wire.faults = SOUND
                wire.noise(40, rigged.lock.clock.now_ns(), 115200)
                wire.faults = LineFaults(silent=True)

            rigged.at(BEGIN + 0.03 * k, spark)
        rigged.at(END, lambda: setattr(wire, "faults", SOUND))

    run = fly(demo_config(DURATION, camera=False), tmp_path, prepare)
    names = event_names(run)
    assert "imu-corrupt" in names
    assert "imu-silent" not in names
    assert true_current(run, BEGIN + WITHIN, END).max() == 0.0


def test_a_unit_that_restarts_is_distinguished_from_noise_and_silence(tmp_path: Path) -> None:
    """A restart of the VN-100 is distinguished from noise and from silence.

    After its reset, the VN-100 sends its default ASCII lines, which are not readings.
    """

    def prepare(rigged: Rigged) -> None:
        host = rigged.lock.line.host
        rigged.at(BEGIN, lambda: host.send(b"$VNRST*4D\r\n"))

    run = fly(demo_config(DURATION, camera=False), tmp_path, prepare, section=AT_TARGET)
    names = event_names(run)
    assert "imu-unusable" in names
    assert "imu-corrupt" not in names
    assert_whole(run)
    recovered = run["event"]["time_ns"][names.index("imu-recovered")] * 1e-9
    assert recovered < BEGIN + 2.5, "the driver has set the unit up again"
    final = 2 * np.arcsin(run["truth"]["quaternion"][-1, 1]) - 2 * np.arcsin(-0.3)
    assert abs(final) < np.radians(4.5)


def test_an_unplugged_port_is_reported_and_the_coils_go_to_zero(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        host = rigged.lock.line.host
        rigged.at(BEGIN, lambda: setattr(host, "unplugged", True))
        rigged.at(END, lambda: setattr(host, "unplugged", False))

    run = fly(demo_config(DURATION, camera=False), tmp_path, prepare)
    names = event_names(run)
    assert names.index("imu-line-lost") < names.index("control-lost") < names.index("control-regained")
    assert true_current(run, BEGIN + WITHIN, END).max() == 0.0
    assert_whole(run)


@pytest.mark.parametrize("fault", ["nack", "hang", "lose_arbitration"])
def test_a_bus_that_fails_is_reported_and_used_again_after_its_recovery(tmp_path: Path, fault: str) -> None:
    def prepare(rigged: Rigged) -> None:
        bus = rigged.lock.hardware.bus

        def begin() -> None:
            if fault == "nack":
                bus.nack(0x40, times=None)
            elif fault == "hang":
                bus.hang(times=None)
            else:
                bus.lose_arbitration(times=None)

        rigged.at(BEGIN, begin)
        rigged.at(END, bus.clear_faults)

    run = fly(demo_config(DURATION, camera=False), tmp_path, prepare, section=AT_TARGET)
    names = event_names(run)
    assert names.index("coil-fault") < names.index("coil-recovered")
    assert run["housekeeping"]["coil_faults"][-1] > 0
    assert_whole(run)
    final = 2 * np.arcsin(run["truth"]["quaternion"][-1, 1]) - 2 * np.arcsin(-0.3)
    assert abs(final) < np.radians(4.5)


def test_a_chip_that_keeps_its_outputs_causes_no_larger_error_than_a_silent_one(
    tmp_path: Path,
) -> None:
    """A PWM chip that keeps its outputs causes no larger error of the estimate than a chip that is silent.

    The chip acknowledges each write. For half a second the filter assumes currents that do not flow.
    """
    world = replace(demo_world(), faults=(FaultEntry(fault="pwm: stuck", at=1.55, span=3.0),))
    run = fly(demo_config(18.0, camera=False), tmp_path, section=world)
    names = event_names(run)
    assert names.index("coil-fault") < names.index("coil-recovered")
    assert "imu-refused" not in names
    control, truth = run["control"], run["truth"]
    error = control["angle"] - 2.0 * np.arcsin(truth["quaternion"][: len(control), 1])
    assert np.nanmax(np.abs(error / control["angle_sigma"])) < 6.0
    final = 2 * np.arcsin(truth["quaternion"][-1, 1]) - 2 * np.arcsin(-0.3)
    assert abs(final) < np.radians(0.15)


def test_a_brown_out_of_the_pwm_chip_is_mended(tmp_path: Path) -> None:
    run = fly(
        demo_config(DURATION, camera=False),
        tmp_path,
        lambda rigged: rigged.at(BEGIN, rigged.lock.hardware.pwm.brown_out),
    )
    assert true_current(run, BEGIN + 2.0, DURATION).max() > 0.0
    assert_whole(run)


@pytest.mark.parametrize(
    ("fault", "event"),
    [("black", "camera-black"), ("saturated", "camera-saturated"), ("frozen", "camera-frozen")],
)
def test_a_camera_with_false_images_is_reported_and_gives_no_rate(
    tmp_path: Path, fault: str, event: str
) -> None:
    def prepare(rigged: Rigged) -> None:
        camera = rigged.lock.hardware.camera
        rigged.at(SHAM, lambda: setattr(camera, "fault", fault))

    run = fly(config_for("testbed-demo", camera=True, duration=5.5), tmp_path, prepare)
    names = event_names(run)
    assert event in names
    streaks = run["streak"]
    assert len(streaks) > 2
    assert streaks["accepted"][1:].sum() == 0
    assert np.isnan(streaks["rate"][1:]).all()


def test_a_camera_that_is_off_is_reported_and_the_flight_goes_on(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        camera = rigged.lock.hardware.camera
        rigged.at(SHAM, lambda: setattr(camera, "fault", "off"))

    run = fly(config_for("testbed-demo", camera=True, duration=5.5), tmp_path, prepare)
    assert "camera-lost" in event_names(run)
    assert len(run["streak"]) == 1
    assert run["control"]["state"][-1] != 0


@pytest.mark.parametrize(("max_age", "lost"), [(5.0, False), (2.5, True)])
def test_a_frame_that_comes_late_is_not_accepted_as_fresh(tmp_path: Path, max_age: float, lost: bool) -> None:
    def prepare(rigged: Rigged) -> None:
        setattr(rigged.lock.hardware.camera, "late_ns", 3_000_000_000)  # noqa: B010 - it may be None

    config = config_for("testbed-demo", camera=True, duration=4.5)
    assert config.camera is not None
    run = fly(replace(config, camera=replace(config.camera, period=20.0, max_age=max_age)), tmp_path, prepare)
    assert len(run["streak"]) == 1
    assert ("camera-lost" in event_names(run)) is lost
    assert "camera-recovered" not in event_names(run)


def test_a_stall_of_the_loop_is_counted_once_and_the_flight_continues(tmp_path: Path) -> None:
    """A stall of the loop for 1 s gives one event and 40 lost slots, which are not run later.

    The coil currents decay during the stall.
    """
    shown: list[FlightProgress] = []

    def prepare(rigged: Rigged) -> None:
        rigged.loop.watch(shown.append)
        camera, clock = rigged.lock.hardware.camera, rigged.lock.clock
        assert camera is not None
        poll, stalled = camera.poll, list[bool]()

        def stall() -> object:
            if clock.now_ns() > rigged.epoch_ns + 4_000_000_000 and not stalled:
                stalled.append(True)
                clock.sleep_until_ns(clock.now_ns() + 1_000_000_000)
            return poll()

        camera.poll = stall  # type: ignore[method-assign,assignment]  # a replaced method

    run = fly(config_for("testbed-demo", camera=True, duration=6.0), tmp_path, prepare)
    names = event_names(run)
    assert names.count("cycle-slip") == 1
    assert shown[-1].slips == run["health"]["slips"][-1], "`run` and `report` count the same slips"
    cycles = run["control"]["cycle"]
    assert np.diff(cycles.astype(int)).max() in {40, 41}
    assert (np.diff(run["control"]["time_ns"]) >= 25_000_000).all()
    assert true_current(run, 4.6, 5.0).max() == 0.0, (
        "a current commanded half a second ago must not be driven"
    )
