"""Tests that a satellite is built as configured, and tests of its estimation and its telemetry."""

from __future__ import annotations

import math
from functools import cache
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

from flight.bodies.orbit import body
from flight.bodies.orbit.body import OrbitView, SatelliteEstimation
from flight.bodies.orbit.filter import BODY, COIL_FACTORS
from flight.link.events import Mode
from flight.link.telemetry.definitions import DESCRIPTION, NAVIGATION, SPIN
from flight.loop.coil_response import CoilCorrection
from flight.loop.facts import FlightClock
from flight.loop.state import Learned
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, as_orbit
from flight.schema.devices import camera_model
from flight.schema.document import ConfigError
from hal.interfaces.devices import GpsReading
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.gnc.estimation.estimate import Knowledge
from sim_hal.clock import SimClock
from tests.support.flights import CONFIG

S = 1_000_000_000
UTC_NS = 1_800_000_000 * S


@cache
def config(name: str = "orbit") -> OrbitConfig:
    """Return a configuration of the folder `config`."""
    return as_orbit(configuration.load(CONFIG.parent / f"{name}.yaml"))


def services() -> Any:
    """Return the services of a flight as test doubles, with a simulated clock."""
    return SimpleNamespace(
        clock=FlightClock(SimClock(UTC_NS)), jobs=Mock(), events=Mock(), facts=Mock(), recorder=Mock()
    )


def estimation(
    given: OrbitConfig | None = None, learned: dict[str, Learned] | None = None
) -> SatelliteEstimation:
    """Return the state estimation of a satellite."""
    return SatelliteEstimation(given or config(), services(), learned or {})


def test_the_accuracies_of_the_description_are_in_radians() -> None:
    changed = configuration.replace(
        config(),
        craft=configuration.replace(
            config().craft,
            accuracy=configuration.replace(
                config().craft.accuracy, moments=0.11, axes_deg=4.0, coil_gain=0.17, coil_axes_deg=2.0
            ),
        ),
        inertial_unit=configuration.replace(
            config().inertial_unit,
            accuracy=configuration.replace(
                config().inertial_unit.accuracy, gyro_scale=4e-3, gyro_alignment=1e-3, field_matrix=0.02
            ),
        ),
    )
    errors = body.description_errors(changed)
    assert (errors.moments, errors.coil_gain) == (0.11, 0.17)
    assert errors.axes == pytest.approx(0.0698, rel=1e-3)
    assert errors.coil_axes == pytest.approx(0.0349, rel=1e-3)
    assert (errors.gyro_scale, errors.gyro_alignment, errors.field_matrix) == (4e-3, 1e-3, 0.02)
    camera = changed.camera
    assert camera is not None
    assert errors.camera == pytest.approx(camera.accuracy.mounting_deg * math.pi / 180.0)
    assert errors.camera > 0.0
    widest = max(one.mounting_deg for one in changed.wide_cameras)
    assert errors.horizon == pytest.approx(widest * math.pi / 180.0)
    without = body.description_errors(configuration.replace(changed, camera=None, wide_cameras=()))
    assert (without.camera, without.horizon) == (0.0, 0.0)


def test_the_filter_gets_noises_and_uniform_errors_of_the_configuration() -> None:
    given = config()
    settings = body.filter_settings(given)
    section, uniform = given.estimation, 1.0 / math.sqrt(3.0)
    assert settings.gyro == (section.bias_start, section.bias_walk)
    dipole, sunlit = given.dipole_errors()
    assert settings.dipole[0] == pytest.approx(uniform * dipole)
    assert settings.sunlit[0] == pytest.approx(uniform * sunlit)
    assert settings.torque == given.torque_sizes()
    assert settings.magnet[0] == pytest.approx(uniform * given.inertial_unit.accuracy.field_bias)
    assert settings.gate_sigma == section.gate_sigma
    # The noise density is the standard deviation per cycle times the square root of the cycle of 25 ms.
    assert settings.coil_noise == pytest.approx(section.current_noise * 0.648 * math.sqrt(0.025))
    assert settings.coils is None, "coils along the body axes have independent errors"
    assert body.filter_settings(config("orbit_1u_tilted")).coils is not None


def test_the_satellite_detumbles_above_the_lower_of_two_rates() -> None:
    given = config()
    camera = given.camera
    assert camera is not None
    slow = configuration.replace(given, camera=configuration.replace(camera, max_rate=0.01))
    assert body.fastest_rate(given) == 0.0175
    assert body.fastest_rate(slow) == 0.01
    assert body.fastest_rate(configuration.replace(given, camera=None)) == 0.0175
    assert body._planned(slow).weights.fastest == pytest.approx(0.008), "paths leave a margin of a fifth"


def test_the_planner_gets_axes_weights_and_the_share_of_the_time_with_current() -> None:
    given = config()
    craft = body._planned(given)
    np.testing.assert_array_equal(np.diag(craft.inertia), [1.10e-3, 1.05e-3, 0.99e-3])
    np.testing.assert_array_equal(craft.axes.pointing, [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(craft.axes.across, [1.0, 0.0, 0.0])
    assert (craft.weights.turn, craft.weights.rate, craft.weights.roll) == (0.0175, 1.0, 0.524)
    assert craft.weights.dipole == given.dipole_weight()
    np.testing.assert_array_equal(craft.weights.axis, [0.0, 0.0, 1.0])
    assert craft.duty == pytest.approx(1.8 / 2.0), "the coils pause for 0.2 s of 2 s"
    # The boresight is body -y, rotated by 22 deg towards -z, as the configuration states.
    turned = math.radians(22.0)
    camera = craft.slew.camera
    assert np.linalg.norm(camera) == pytest.approx(1.0)
    np.testing.assert_allclose(camera, [0.0, -math.cos(turned), -math.sin(turned)], atol=2e-3)
    without = body._planned(configuration.replace(given, camera=None))
    np.testing.assert_array_equal(without.slew.camera, [0.0, 0.0, 1.0])
    assert craft.slew.seconds == given.slew_duration()


def test_a_camera_that_searches_for_objects_has_the_field_of_its_shorter_side() -> None:
    assert body._sensor(config()) is None, "the camera searches for no objects"
    given = config("orbit_object")
    sensor = body._sensor(given)
    camera = given.camera
    assert sensor is not None
    assert camera is not None
    np.testing.assert_allclose(sensor.boresight, attitude_matrix(np.array(camera.mounting))[2], atol=1e-12)
    wide = configuration.replace(given, camera=configuration.replace(camera, columns=4 * camera.rows))
    wider = body._sensor(wide)
    assert wider is not None
    focal = camera_model(wide.camera).focal_length  # type: ignore[arg-type]
    assert wider.half_field == pytest.approx(math.atan(camera.rows / 2.0 / focal))


def test_the_coil_monitor_knows_full_currents_and_the_disturbance() -> None:
    found = estimation()
    monitor = found.coil_monitor
    settings = monitor._settings
    assert settings.full_current == pytest.approx((3.4 / 23.0,) * 3)
    assert settings.tumble_rate == 0.0175
    assert settings.self_test is not None
    assert settings.absent == frozenset()
    response = settings.response
    assert response is not None
    assert response.disturbance is not None
    assert response.settle_ns == 100_000_000
    np.testing.assert_allclose(np.diag(response.dipole_per_ampere), 0.648)
    _, dipole = config().largest_torques()
    moments = np.array([1.1e-3, 1.05e-3, 0.99e-3])
    cast(Any, found.environment).state = lambda _: None
    assert response.disturbance(0) == pytest.approx(dipole / moments), "without an orbit, no air"
    low = SimpleNamespace(position=np.array([0.0, 0.0, 6.878e6]))
    cast(Any, found.environment).state = lambda _: low
    assert (response.disturbance(0) > dipole / moments).all()
    never = configuration.replace(config(), pointing=configuration.replace(config().pointing, coil_test=0.0))
    assert estimation(never).coil_monitor._settings.self_test is None


def test_wrong_elements_name_their_key() -> None:
    with pytest.raises(ConfigError, match="not valid two-line elements"):
        estimation(configuration.replace(config(), elements=("1 wrong", "2 wrong")))


def test_without_solar_cells_there_is_no_sun_acquisition() -> None:
    given = configuration.replace(config(), solar_strings=None)
    found = estimation(given)
    assert found.sun_acquisition is None
    assert found.accept_sun(cast(Any, None)) is None
    made = body.make(given, services(), {})
    assert made.control.sun_acquisition is None


def test_a_satellite_is_made_with_its_axes_modes_and_dipoles() -> None:
    made = body.make(config(), services(), {})
    assert Mode.POINT in made.control.modes
    assert Mode.TESTBED_DEMO not in made.control.modes
    np.testing.assert_allclose(made.control.dipoles, 0.648 * np.eye(3))
    assert made.control.free_axis is None
    assert made.control.sun_acquisition is made.estimation.sun_acquisition  # type: ignore[attr-defined]
    assert made.view.mode_fields(None).keys() == {"target_q2"}


@pytest.mark.parametrize("name", ["orbit", "orbit_6u_redundant"])
def test_coil_factors_that_an_earlier_boot_learned_are_used(name: str) -> None:
    count = len(config(name).coils.windings)
    factors = np.array([0.8, -1.0, 0.9, 0.7][:count])
    learned = {COIL_FACTORS: Learned.of(factors, np.diag(np.full(count, 1e-4)))}
    found = estimation(config(name), learned)
    np.testing.assert_allclose(found.coil_monitor.correction.factors, factors)
    np.testing.assert_allclose(found.coil_monitor.correction.deviations, 0.01)
    assert found.learned_problems == []
    bad = {COIL_FACTORS: Learned.of(np.array([0.8, 1.0]), 1e-4 * np.eye(2))}
    (problem,) = estimation(config(name), bad).learned_problems
    assert problem.startswith(COIL_FACTORS)


class Estimating:
    """A satellite's estimation whose filter and environment are test doubles."""

    def __init__(self, name: str = "orbit") -> None:
        self.found = estimation(config(name))
        self.filter, self.environment = Mock(), Mock()
        self.found.orbit_filter, self.found.environment = self.filter, self.environment


def diagonal(rate: float) -> Any:
    """Return an estimate whose largest variance of the rate, about z, is `rate` squared."""
    variances = np.array([1.0, 1.0, 1.0, 0.25 * rate**2, 0.5 * rate**2, rate**2])
    return SimpleNamespace(covariance=np.diag(variances), rate=np.array([0.1, 0.2, 0.3]), time_ns=5,
                           quaternion=normalise(np.array([0.1, 0.2, 0.3, 0.9])))  # fmt: skip


@pytest.mark.parametrize(("sigma", "accurate"), [(8.699e-3, True), (8.701e-3, False)])
def test_a_rate_is_accurate_if_its_error_is_below_the_rate_that_ends_detumbling(
    sigma: float, accurate: bool
) -> None:
    assert estimation().is_accurate(diagonal(sigma)) is accurate


@pytest.mark.parametrize(("share", "known"), [(0.999, True), (1.001, False)])
def test_a_rate_of_the_filter_replaces_the_gyro_if_it_is_as_accurate(share: float, known: bool) -> None:
    bench = Estimating()
    bench.filter.started = True
    bench.filter.at.return_value = diagonal(share * config().estimation.bias_start)
    rate = bench.found.rate_without_gyro(7)
    assert (rate is not None) is known
    if rate is not None:
        assert rate.tolist() == [0.1, 0.2, 0.3]
    bench.filter.at.assert_called_once_with(7)
    bench.filter.started = False
    assert bench.found.rate_without_gyro(7) is None


def test_the_largest_likely_rate_from_the_magnetometer_adds_one_sigma() -> None:
    bench = Estimating()
    bench.filter.rate_by_field.return_value = None
    assert math.isinf(bench.found.fastest_by_field())
    spread = np.diag([1e-4, 9e-4, 4e-4])
    bench.filter.rate_by_field.return_value = SimpleNamespace(
        rate=np.array([0.3, 0.0, 0.4]), covariance=spread
    )
    assert bench.found.fastest_by_field() == pytest.approx(0.5 + 0.03)


def test_the_expected_field_is_in_body_axes_and_zero_without_an_orbit() -> None:
    bench = Estimating()
    estimate = diagonal(0.1)
    field = np.array([2e-5, -1e-5, 3e-5])
    bench.environment.field.return_value = field
    np.testing.assert_allclose(bench.found.field(estimate), attitude_matrix(estimate.quaternion) @ field)
    bench.environment.field.assert_called_once_with(5)
    bench.environment.field.return_value = None
    assert bench.found.field(estimate).tolist() == [0.0, 0.0, 0.0]


def fix(time_ns: int) -> GpsReading:
    """Return a GPS fix at a time in ns."""
    zero = np.zeros(3)
    return GpsReading(time_ns, time_ns, UTC_NS, zero, zero, 3.0, 0.2, 9, True)


@pytest.mark.parametrize(("age", "recent"), [(20 * S, True), (20 * S + 1, False), (-20 * S, True)])
@pytest.mark.parametrize(("share", "lit"), [(0.5, True), (0.499, False), (1.5, True), (1.7, False)])
def test_a_fix_is_judged_with_the_recent_field_and_the_brightest_solar_cell(
    age: int, recent: bool, share: float, lit: bool
) -> None:
    bench = Estimating()
    now = 100 * S
    bench.filter.field_at_rest = (now - age, 4e-5)
    peaks = bench.found._sun.strings.peaks  # type: ignore[union-attr]
    currents = np.zeros(len(peaks))
    currents[2] = share * peaks[2]
    bench.found._sun.newest = cast(Any, SimpleNamespace(time_ns=now - age, currents=currents))  # type: ignore[union-attr]
    bench.environment.fix.return_value, bench.environment.refusal = True, "why"
    verdict = bench.found.accept_fix(fix(now))
    assert (verdict.used, verdict.refusal) == (True, "why")
    reading, witness = bench.environment.fix.call_args.args
    assert reading.time_ns == now
    assert witness.sunlit is (recent and lit)
    accuracy = config().inertial_unit.accuracy
    if recent:
        assert witness.field == 4e-5
        largest = math.hypot(accuracy.field_bias, accuracy.field_matrix * 4e-5)
        assert witness.field_sigma == pytest.approx(largest / math.sqrt(3.0))
    else:
        assert witness.field is None
        assert math.isinf(witness.field_sigma)


def test_a_fix_without_other_measurements_has_no_witness() -> None:
    bench = Estimating()
    bench.filter.field_at_rest = None
    bench.environment.fix.return_value, bench.environment.refusal = False, ""
    assert not bench.found.accept_fix(fix(5)).used
    _, witness = bench.environment.fix.call_args.args
    assert (witness.field, witness.sunlit) == (None, False)


def test_sun_readings_go_to_the_acquisition_and_to_the_filter() -> None:
    bench = Estimating()
    bench.found.sun_acquisition, bench.found._sun = Mock(), Mock()
    bench.found._sun.accept.return_value = "dim"
    assert bench.found.accept_sun(cast(Any, "reading")) == "dim"
    bench.found.sun_acquisition.update_sun.assert_called_once_with("reading")
    bench.found._sun.accept.assert_called_once_with("reading")


def test_estimates_of_the_filter_are_stored_with_the_factors_of_the_coils() -> None:
    found = estimation()
    correction = CoilCorrection()
    correction.weigh(1, 0.8)
    found.coil_monitor.correction = correction
    stored = found.learned(cast(Any, None))
    values, spread = stored[COIL_FACTORS].arrays()
    np.testing.assert_array_equal(values, correction.factors)
    np.testing.assert_allclose(np.diag(spread), correction.deviations**2)
    assert BODY in stored


def test_a_matrix_of_redundant_coils_is_not_stored_while_a_coil_is_isolated() -> None:
    found = estimation(config("orbit_6u_redundant"))
    used = np.ones(len(config("orbit_6u_redundant").coils.windings), dtype=bool)
    found.coils_used(np.array([False, *used[1:]]))
    assert BODY not in found.learned(cast(Any, None)), "nothing was learned with all coils"
    found.coils_used(used)
    whole = found.learned(cast(Any, None))[BODY]
    found.coils_used(np.array([False, *used[1:]]))
    assert found.learned(cast(Any, None))[BODY] is whole
    plain = estimation()
    plain.coils_used(np.array([False, True, True]))
    assert BODY in plain.learned(cast(Any, None)), "three coils keep their matrix"


def test_a_change_of_devices_reaches_the_detumbler() -> None:
    """A reversed coil must not be corrected twice: in the detumbler's matrix and in the commands."""
    calls: list[str] = []
    found: Any = estimation()
    found.detumbler = SimpleNamespace(
        renew_coils=lambda: calls.append("coils"), renew_magnetometer=lambda: calls.append("magnetometer")
    )
    found.coils_corrected(np.array([-1.0, 1.0, 1.0]), np.full(3, 0.1))
    found.coils_used(np.array([False, True, True]))
    found.magnetometer_changed()
    assert calls == ["coils", "coils", "magnetometer"]


@pytest.mark.parametrize(("name", "renewed"), [("orbit", 0), ("orbit_6u_redundant", 1)])
def test_a_change_of_redundant_coils_resets_their_learned_matrix(name: str, renewed: int) -> None:
    bench = Estimating(name)
    count = len(config(name).coils.windings)
    used = np.array([False, *[True] * (count - 1)])
    bench.found.coils_used(used)
    assert bench.filter.renew_coils.call_count == renewed
    bench.filter.reset_mock()
    change, deviations = np.full(count, 0.9), np.full(count, 0.1)
    bench.found.coils_corrected(change, deviations)
    bench.filter.correct_coils.assert_called_once_with(change, deviations)
    assert bench.filter.renew_coils.call_count == renewed
    if renewed:
        covariance, flags = bench.filter.renew_coils.call_args.args
        np.testing.assert_array_equal(flags, used)
        assert (np.linalg.eigvalsh(covariance) >= -1e-15).all()


class Viewed:
    """The telemetry of the satellite, with test doubles that record the packets, events and conditions."""

    def __init__(self) -> None:
        self.records: list[tuple[Any, dict[str, Any]]] = []
        self.reports: list[str] = []
        self.said: dict[str, tuple[bool | None, str]] = {}
        self.filter = SimpleNamespace(
            knowledge=Knowledge.LOST, contradictions=[], field_doubt="", refused=4, restarts=5,
            residual_dipole=np.array([1e-3, 2e-3, 3e-3]),
            description=lambda now: {"inertia": np.array([[1.0, 2.0], [3.0, 4.0]])},
        )  # fmt: skip
        self.environment = SimpleNamespace(
            known=True, field_sigma=lambda now: 0.0, clock_doubt="", is_timed=False, refused=6
        )
        self.detumbler = SimpleNamespace(rate=None, field=None, rate_sigma=0.01, restarts=3)
        made = SimpleNamespace(
            events=SimpleNamespace(report=lambda kind, _, text: self.reports.append(f"{kind.name}: {text}")),
            facts=SimpleNamespace(
                update=lambda fact, holds, _, text: self.said.__setitem__(fact.name, (holds, text))
            ),
            recorder=SimpleNamespace(
                record=lambda packet, _, **values: self.records.append((packet, values))
            ),
        )
        law = SimpleNamespace(detumbler=self.detumbler)
        self.view = OrbitView(
            cast(Any, law), cast(Any, self.filter), cast(Any, self.environment), cast(Any, made)
        )

    def cycle(self, slot: int, mode: Mode = Mode.POINT, estimate: Any = None) -> Any:
        """Record a cycle, and return its output."""
        output = SimpleNamespace(
            cycle=SimpleNamespace(slot=slot, start_ns=5), mode=mode, estimate=estimate,
            steered=SimpleNamespace(dipole=np.array([0.1, 0.2, 0.3])),
        )  # fmt: skip
        self.view.record_cycle(cast(Any, output))
        return output

    def of(self, packet: Any) -> list[dict[str, Any]]:
        """Return the values of all recorded packets of a type."""
        return [values for kind, values in self.records if kind is packet]


def test_a_change_of_the_attitude_knowledge_is_an_event() -> None:
    viewed = Viewed()
    viewed.cycle(1)
    viewed.filter.knowledge = Knowledge.COARSE
    viewed.cycle(2)
    viewed.cycle(3)
    assert viewed.reports == [f"attitude-knowledge: {Knowledge.LOST.value} -> {Knowledge.COARSE.value}"]


def test_the_navigation_packet_comes_once_a_second_with_its_values() -> None:
    viewed = Viewed()
    viewed.filter.knowledge = Knowledge.FINE
    estimate = SimpleNamespace(bias=np.array([1e-4, 2e-4, 3e-4]), field_bias=np.array([1e-7, 2e-7, 3e-7]))
    for slot in range(1, 81):
        viewed.cycle(slot, estimate=estimate)
    first, _ = viewed.of(NAVIGATION)
    assert first == {
        "knowledge": 2, "placed": 1, "refused": 4, "fixes_refused": 6, "restarts": 5,
        "gyro_bias": [1e-4, 2e-4, 3e-4], "field_bias": [1e-7, 2e-7, 3e-7],
        "residual_dipole": [1e-3, 2e-3, 3e-3],
    }  # fmt: skip
    assert viewed.of(DESCRIPTION) == []
    viewed.cycle(400, estimate=estimate)
    assert viewed.of(DESCRIPTION) == [{"inertia": [1.0, 2.0, 3.0, 4.0]}]
    viewed.cycle(800)
    assert len(viewed.of(DESCRIPTION)) == 1, "there is no estimate"
    last = viewed.of(NAVIGATION)[-1]
    assert np.isnan([*last["gyro_bias"], *last["field_bias"], *last["residual_dipole"]]).all()
    viewed.environment.known, viewed.filter.knowledge = False, Knowledge.COARSE
    viewed.cycle(840)
    assert (viewed.of(NAVIGATION)[-1]["placed"], viewed.of(NAVIGATION)[-1]["knowledge"]) == (0, 1)


def test_the_spin_packet_comes_four_times_a_second_in_detumbling_only() -> None:
    viewed = Viewed()
    for slot in range(1, 21):
        viewed.cycle(slot, Mode.POINT)
    assert viewed.of(SPIN) == []
    for slot in range(1, 21):
        viewed.cycle(slot, Mode.DETUMBLE)
    first, _ = viewed.of(SPIN)
    assert (first["known"], first["rate_sigma"], first["restarts"]) == (0, 0.01, 3)
    assert first["dipole"] == [0.1, 0.2, 0.3]
    assert np.isnan([*first["rate"], *first["field"]]).all()
    viewed.detumbler.rate, viewed.detumbler.field = np.array([0.1, 0.0, 0.2]), np.array([1e-5, 2e-5, 3e-5])
    viewed.cycle(30, Mode.DETUMBLE)
    last = viewed.of(SPIN)[-1]
    assert (last["known"], last["rate"], last["field"]) == (1, [0.1, 0.0, 0.2], [1e-5, 2e-5, 3e-5])


def test_an_extrapolated_field_is_reported_with_its_error() -> None:
    viewed = Viewed()
    viewed.cycle(40)
    exact, _ = viewed.said["field-extrapolated"]
    assert exact is False
    viewed.environment.field_sigma = lambda now: 1.5e-7
    viewed.cycle(80)
    holds, text = viewed.said["field-extrapolated"]
    assert (holds, "additional error of 150 nT" in text) == (True, True)
    viewed.environment.known = False
    viewed.cycle(120)
    unknown, _ = viewed.said["field-extrapolated"]
    assert unknown is None
    viewed.said.clear()
    viewed.cycle(121)
    assert viewed.said == {}, "checked once a second"


def test_a_doubted_clock_is_reported_until_it_is_set() -> None:
    viewed = Viewed()
    viewed.cycle(40)
    assert "clock-off" not in viewed.said
    viewed.environment.clock_doubt = "the elements are from tomorrow"
    viewed.cycle(80)
    assert viewed.said["clock-off"] == (True, "the elements are from tomorrow")
    viewed.environment.clock_doubt = ""
    viewed.cycle(120)
    assert viewed.said["clock-off"] == (False, "the clock is set from the date of the elements")
    viewed.said.clear()
    viewed.cycle(160)
    assert "clock-off" not in viewed.said, "reported once"
    viewed.environment.clock_doubt = "again"
    viewed.cycle(200)
    viewed.said.clear()
    viewed.environment.clock_doubt, viewed.environment.is_timed = "", True
    viewed.cycle(240)
    assert "clock-off" not in viewed.said, "the receiver judges the clock"


def test_a_refused_magnetometer_is_reported() -> None:
    viewed = Viewed()
    viewed.cycle(40)
    assert viewed.said["field-refused"] == (False, "the magnetometer agrees with the estimate")
    viewed.filter.field_doubt = "the field does not change"
    viewed.cycle(80)
    assert viewed.said["field-refused"] == (True, "the field does not change")


def test_the_progress_line_shows_mode_and_rate_or_knowledge() -> None:
    viewed = Viewed()
    output = viewed.cycle(1, Mode.DETUMBLE)
    assert viewed.view.progress(None) == Mode.BOOT.label
    assert viewed.view.progress(output) == Mode.DETUMBLE.label
    viewed.detumbler.rate = np.radians(np.array([3.0, 0.0, 4.0]))
    assert viewed.view.progress(output) == f"{Mode.DETUMBLE.label} 5.00 deg/s from the magnetometer"
    assert viewed.view.progress(viewed.cycle(1, Mode.ACQUIRE)) == Mode.ACQUIRE.label
    viewed.filter.knowledge = Knowledge.FINE
    output = viewed.cycle(2, Mode.POINT)
    assert viewed.view.progress(output) == f"{Mode.POINT.label}, attitude {Knowledge.FINE.value}"


def test_a_target_is_reported_with_its_text_and_a_rate_in_degrees() -> None:
    viewed = Viewed()
    viewed.view.announce(cast(Any, SimpleNamespace(law=SimpleNamespace(text="nadir"))), 5)
    assert viewed.reports == ["target: nadir"]
    rate = SimpleNamespace(rate=np.radians([1.0, -2.0, 0.5]))
    assert viewed.view.rate_text(cast(Any, rate)) == "[1.0, -2.0, 0.5] deg/s"
