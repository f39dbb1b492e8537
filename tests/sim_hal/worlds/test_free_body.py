"""Tests of the world `free_body`: true craft, rotation and configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flight.bodies.orbit.body import filter_settings
from flight.schema import reader
from flight.schema.bodies import as_orbit
from flight.schema.document import ConfigError
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from sim_hal.description_errors import description_errors
from sim_hal.settings import CraftSection, Disturbances, FreeBodySection, OrbitSection, Simulation, TipOff
from sim_hal.worlds import free_body
from sim_hal.worlds.free_body import (
    CRAFTS,
    FreeBody,
    Loads,
    Rotation,
    State,
    _stepped,
    box,
    build,
    built_craft,
    craft_model,
)
from sim_hal.worlds.world import World, WorldInputs, make_world
from tests.support.compiled_forms import assert_forms_agree
from tests.support.flights import demo_config, demo_world
from tests.support.pointing_settings import WEIGHTS

SECOND = 1_000_000_000
MOVING = np.array([0.02, 0.0, -0.04])


def released(section: FreeBodySection, seed: int = 1, currents: FloatArray = MOVING) -> FreeBody:
    body = FreeBody(section, lambda: currents, seed=seed)
    body.release_at(2 * SECOND)
    return body


def test_the_body_does_not_move_before_its_release_while_the_orbit_continues() -> None:
    body = released(FreeBodySection(release=TipOff(speed=0.2)))
    first = body.motion(0)
    held = body.motion(2 * SECOND - 1)
    np.testing.assert_array_equal(first.quaternion, held.quaternion)
    assert not held.rate.any()
    assert np.linalg.norm(body.orbit_truth().velocity) == pytest.approx(7612.6, abs=20.0)
    assert np.abs(held.field_body - first.field_body).max() > 1e-9
    later = body.motion(3 * SECOND)
    assert np.linalg.norm(later.rate) == pytest.approx(0.2, abs=0.01)
    assert body.energy == pytest.approx(23.0 * float(MOVING @ MOVING), rel=1e-6)
    assert body.supply_energy == pytest.approx(3.4 * 0.06, rel=1e-6)


def test_the_result_hardly_depends_on_the_number_of_time_steps_and_reads() -> None:
    seldom, often = released(FreeBodySection()), released(FreeBodySection())
    for step in range(1, 4001):
        often.advance_to(step * SECOND // 200)
    seldom.advance_to(20 * SECOND)
    np.testing.assert_array_equal(seldom.motion(20 * SECOND).quaternion, often.motion(20 * SECOND).quaternion)
    looked_at = released(FreeBodySection())
    for step in range(1, 1601):
        looked_at.motion(step * SECOND // 80)
    other = looked_at.motion(20 * SECOND).quaternion
    assert quaternion.angle_between(seldom.motion(20 * SECOND).quaternion, other) < 1e-6


def test_a_change_of_currents_acts_from_its_own_time_on() -> None:
    currents = [np.zeros(3)]
    body = FreeBody(FreeBodySection(release=TipOff(speed=0.0)), lambda: currents[0])
    body.release_at(0)
    body.advance_to(10 * SECOND)
    currents[0] = np.array([0.1, 0.0, 0.0])
    body.advance_to(11 * SECOND)
    assert body.truth().energy == pytest.approx(23.0 * 0.01)
    np.testing.assert_array_equal(body.truth().current, currents[0])


def test_a_seed_draws_another_craft_and_the_multiples_only_scale_it() -> None:
    def craft(seed: int, multiple: float) -> FloatArray:
        settings = Disturbances(residual_dipole=multiple)
        return build(CRAFTS["knightcube"], settings, np.random.default_rng(seed)).constant_dipole

    np.testing.assert_allclose(craft(1, 0.1), 0.1 * craft(1, 1.0))
    assert np.linalg.norm(craft(1, 1.0)) == pytest.approx(1e-3)
    assert np.abs(craft(2, 1.0) - craft(1, 1.0)).max() > 1e-4


def test_the_errors_of_craft_and_coils_are_as_large_as_asked_for() -> None:
    crafts = [build(CRAFTS["cubesat_3u"], Disturbances(), np.random.default_rng(seed)) for seed in range(300)]
    turns = np.degrees([np.linalg.norm(quaternion.to_rotation_vector(c.to_principal)) for c in crafts])
    assert 1.0 <= turns.min() < 1.2
    assert 2.8 < turns.max() <= 3.0
    lengths = np.array([np.linalg.norm(c.coil_dipole, axis=0) for c in crafts]) / 3.4
    assert np.std(lengths) == pytest.approx(0.03, rel=0.1)
    cosines = np.array([np.diag(c.coil_dipole) / np.linalg.norm(c.coil_dipole, axis=0) for c in crafts])
    assert np.degrees(np.sqrt(np.mean(np.arccos(cosines) ** 2))) == pytest.approx(np.sqrt(2.0), rel=0.1)


def test_drag_on_a_box_is_its_arm_across_the_force_on_its_shadow() -> None:
    """For a convex box, the drag torque equals the torque of the total force at the centre of the box."""
    arm, flow = np.array([0.01, -0.005, 0.015]), np.array([5000.0, 4000.0, -3000.0])
    faces = box((0.3, 0.1, 0.2), arm, np.zeros(6))
    shadow = np.array([0.02, 0.06, 0.03]) @ np.abs(flow)
    expected = np.cross(arm, -0.5 * 2.2 * 1e-12 * shadow * flow)
    x, y, z = flow.tolist()
    np.testing.assert_allclose(free_body.air_torque(faces, (x, y, z), 1e-12), expected, rtol=1e-12)


def test_sunlight_on_a_black_box_pushes_away_and_on_a_mirror_twice_as_hard() -> None:
    arm = np.array([0.0, 0.02, 0.0])
    black = free_body.sunlight_torque(box((0.1, 0.1, 0.1), arm, np.zeros(6)), (1.0, 0.0, 0.0), 1.0)
    np.testing.assert_allclose(black, [0.0, 0.0, 0.02 * 4.56e-6 * 0.01], atol=1e-20)
    mirror = free_body.sunlight_torque(box((0.1, 0.1, 0.1), arm, np.ones(6)), (1.0, 0.0, 0.0), 1.0)
    np.testing.assert_allclose(mirror, 2.0 * np.array(black), atol=1e-20)
    dark = free_body.sunlight_torque(box((0.1, 0.1, 0.1), arm, np.ones(6)), (1.0, 0.0, 0.0), 0.0)
    assert dark == (0.0, 0.0, 0.0)


def test_the_disturbances_of_a_3u_have_the_sizes_that_the_design_names() -> None:
    """The disturbances of a 3U at 500 km agree with the values of the design.

    The gravity gradient is 4.9e-8 N m, a dipole of 1e-3 A m^2 gives 2 to 5e-8 N m, and drag along x 6e-9 N m.
    """
    sizes: dict[str, list[float]] = {}
    for seed in range(12):
        body = FreeBody(FreeBodySection(craft="cubesat_3u"), lambda: np.zeros(3), seed=seed)
        for time in range(0, 2000, 100):
            body.advance_to(time * SECOND)
            for cause, torque in body.orbit_truth().torques().items():
                sizes.setdefault(cause, []).append(float(np.linalg.norm(torque)))
    assert 4.4e-8 < max(sizes["gravity gradient"]) <= 5.0e-8
    assert 1e-8 < np.median(sizes["residual dipole"]) < max(sizes["residual dipole"]) < 7e-8
    assert 3e-9 < np.median(sizes["drag"]) < max(sizes["drag"]) < 6e-8
    assert 1e-9 < max(sizes["sunlight"]) < 6e-9
    assert max(sizes["coils"]) == 0.0


def test_the_residual_dipole_has_a_part_that_goes_in_shadow() -> None:
    body = FreeBody(FreeBodySection(orbit=OrbitSection(local_time=12.0)), lambda: np.zeros(3))
    lit: list[FloatArray] = []
    dark: list[FloatArray] = []
    for time in range(0, 5600, 50):
        body.advance_to(time * SECOND)
        truth = body.orbit_truth()
        (lit if truth.sunlit == 1.0 else dark if truth.sunlit == 0.0 else []).append(truth.residual_dipole)
    difference = np.linalg.norm(np.mean(lit, axis=0) - np.mean(dark, axis=0))
    assert difference == pytest.approx(3e-4, abs=1.2e-4)


def test_a_configuration_names_the_free_body_and_must_describe_it() -> None:
    config = demo_config(1.0, camera=False)
    section = reader.replace(demo_world(), world="free_body")
    with pytest.raises(ConfigError, match="free_body: is missing"):
        make_world(WorldInputs(config, section, lambda: np.zeros(3), 0))
    described = reader.replace(section, free_body=FreeBodySection(), release=None)
    world = make_world(WorldInputs(config, described, lambda: np.zeros(3), 0))
    assert isinstance(world, World)
    unreleased = reader.replace(described, world="testbed")
    with pytest.raises(ConfigError, match=r"simulation\.release"):
        make_world(WorldInputs(config, unreleased, lambda: np.zeros(3), 0))


def test_the_documents_section_is_read_and_flies() -> None:
    """The example section of docs/fly/simulation.md is read, and a run with it succeeds."""
    page = Path("docs/fly/simulation.md").read_text(encoding="utf-8")
    text = page.split("worlds/test_free_body.py -->\n```yaml\n")[1].split("```")[0]
    section = reader.simulation_section(text, "simulation.md", Simulation)
    assert section is not None
    world = make_world(WorldInputs(demo_config(1.0, camera=False), section, lambda: np.zeros(3), 0))
    assert isinstance(world, FreeBody)
    np.testing.assert_array_equal(np.diag(world.craft.inertia), CRAFTS["cubesat_3u"].inertia)


QUIET = Disturbances(drag=0.0, solar_pressure=0.0, residual_dipole=0.0)
FREE = Disturbances(gravity_gradient=0.0, drag=0.0, solar_pressure=0.0, residual_dipole=0.0)
NO_CURRENT = np.zeros(3)


def flown(section: FreeBodySection, seconds: float, currents: FloatArray, step: float = 0.025) -> FreeBody:
    body = FreeBody(section, lambda: currents, seed=3)
    body.release_at(0)
    for k in range(round(seconds / step)):
        body.motion(round((k + 1) * step * SECOND))
    return body


def inertia_matrix(body: FreeBody) -> FloatArray:
    turn = quaternion.attitude_matrix(body.craft.to_principal)
    return np.asarray(turn.T @ np.diag(body.craft.inertia) @ turn)


def independent(
    body: FreeBody, start: FloatArray, currents: FloatArray, seconds: float, loads: bool
) -> FloatArray:
    """Return quaternion and rate (7,) by DOP853, in body axes with a full inertia matrix."""
    inertia = inertia_matrix(body)

    def slope(time: float, state: FloatArray) -> FloatArray:
        q, w = state[:4], state[4:]
        around = body.environment.at(time)
        turn = quaternion.attitude_matrix(q / np.linalg.norm(q))
        position, field = turn @ around.position, turn @ around.field
        dipole = body.craft.coil_dipole @ currents
        torque = np.zeros(3)
        if loads:
            dipole = dipole + body._loads.residual_dipole(around)
            x, y, z, u, v, p, a, b, c = turn.ravel().tolist()
            drag, sunlight = body._loads.pressures(around, (x, y, z, u, v, p, a, b, c))
            torque = np.add(drag, sunlight)
        pull = 3.0 * GRAVITATIONAL_PARAMETER / np.linalg.norm(position) ** 5
        torque = torque + pull * np.cross(position, inertia @ position) + np.cross(dipole, field)
        change = np.linalg.solve(inertia, torque - np.cross(w, inertia @ w))
        return np.concatenate([quaternion.derivative(q, w), change])

    solved = solve_ivp(slope, (0.0, seconds), start, method="DOP853", rtol=1e-12, atol=1e-13, max_step=1.0)
    return np.asarray(solved.y[:, -1])


@pytest.mark.parametrize("craft", ["knightcube", "cubesat_3u"])
def test_the_motion_under_coils_and_gravity_gradient_equals_that_of_another_integrator(
    craft: Literal["knightcube", "cubesat_3u"],
) -> None:
    section = FreeBodySection(craft=craft, disturbances=QUIET)
    currents = np.array([0.03, -0.02, 0.05])
    still = flown(section, 0.0, currents)
    motion = still.motion(0)
    body = flown(section, 60.0, currents)
    expected = independent(body, np.concatenate([motion.quaternion, still._tip_off]), currents, 60.0, False)
    assert quaternion.angle_between(body.motion(60 * SECOND).quaternion, expected[:4]) < 1e-9
    np.testing.assert_allclose(body.motion(60 * SECOND).rate, expected[4:], atol=1e-10)


def test_loads_held_for_a_tenth_of_a_second_turn_the_body_by_a_microradian_at_most() -> None:
    section = FreeBodySection()
    still = flown(section, 0.0, NO_CURRENT)
    start = np.concatenate([still.motion(0).quaternion, still._tip_off])
    body = flown(section, 60.0, NO_CURRENT)
    expected = independent(body, start, NO_CURRENT, 60.0, True)
    assert 1e-12 < quaternion.angle_between(body.motion(60 * SECOND).quaternion, expected[:4]) < 1e-6


@pytest.mark.parametrize("speed", [0.05, 0.5, 3.0])
def test_without_torque_energy_and_momentum_are_kept(speed: float) -> None:
    section = FreeBodySection(craft="cubesat_3u", disturbances=FREE, release=TipOff(speed=speed))
    body = flown(section, 0.0, NO_CURRENT)
    inertia = inertia_matrix(body)

    def invariants(time: float) -> tuple[float, FloatArray]:
        motion = body.motion(round(time * SECOND))
        momentum = inertia @ motion.rate
        return 0.5 * float(motion.rate @ momentum), quaternion.attitude_matrix(motion.quaternion).T @ momentum

    first_energy, first_momentum = invariants(0.025)
    for time in (10.0, 50.0, 100.0):
        energy, momentum = invariants(time)
        assert energy == pytest.approx(first_energy, rel=1e-9)
        np.testing.assert_allclose(
            momentum, first_momentum, atol=2e-9 * float(np.linalg.norm(first_momentum))
        )


def test_a_body_at_the_stable_attitude_swings_with_the_known_period() -> None:
    """Near the stable attitude, a body oscillates in pitch with omega^2 = 3 n^2 (J_x - J_z) / J_y.

    The formula is in Wertz 1978, 18.3.
    """
    inertia = (0.0333, 0.0333, 0.0066)
    rotation, n = Rotation(inertia), 1.1e-3
    expected = 2.0 * np.pi / (n * np.sqrt(3.0 * (inertia[0] - inertia[2]) / inertia[1]))
    state: State = (0.0, 1e-3, 0.0, 1.0, 0.0, 0.0, 0.0)
    loads = Loads((0.0, 0.0, 0.0), (0.0, 0.0, np.sqrt(3.0) * n), (0.0, 0.0, 0.0))
    crossings: list[float] = []
    time, dt = 0.0, 1.0
    while len(crossings) < 3:
        after = rotation.step(state, dt, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), loads)
        if after[1] * state[1] < 0.0:
            crossings.append(time + dt * state[1] / (state[1] - after[1]))
        state, time = after, time + dt
    assert crossings[2] - crossings[0] == pytest.approx(expected, rel=1e-5)


def test_the_compiled_step_equals_the_plain_step() -> None:
    state, field, ahead = (0.1, 0.2, 0.3, 0.9, 0.1, 0.12, -0.05), (2e-5, 1e-5, 3e-5), (2e-5, 2e-5, 3e-5)
    loads = (0.01, -0.02, 0.03), (1e-3, -8e-4, 1e-3), (1e-8, 2e-8, -1e-8)
    factors = (0.05, -0.1, 0.04), (900.0, 950.0, 1000.0)
    assert_forms_agree(_stepped, state, 0.025, field, ahead, *loads, *factors, relative=1e-14)


FOLDER = Path(__file__).resolve().parents[3] / "config"


@pytest.mark.parametrize("name", ["orbit.yaml", "orbit_3u.yaml", "orbit_object.yaml", "orbit_object_1u.yaml"])
def test_configured_coils_and_inertia_agree_with_the_true_ones(name: str) -> None:
    """The configuration has the coils and the inertia of the world, within a few per cent.

    Entirely different coils would be a wrong configuration.
    """
    config = as_orbit(reader.load(FOLDER / name))
    text = (FOLDER / name).read_text(encoding="utf-8")
    section = reader.simulation_section(text, name, Simulation)
    assert section is not None
    assert section.free_body is not None
    true = craft_model(section.free_body, config)
    np.testing.assert_array_equal(true.dipoles, config.coils.map().dipoles)
    np.testing.assert_array_equal(true.inertia, config.craft.inertia_matrix())
    assert true.size == config.craft.size


def test_the_dipole_of_a_coil_varies_every_twenty_seconds() -> None:
    """The dipole of a coil changes every twenty seconds.

    The torque of the only driven coil, relative to the mean dipole's torque, shows the coil's dipole.
    """
    varied = FreeBodySection(craft="cubesat_3u", disturbances=Disturbances(coil_variation=0.02))
    current = np.array([0.1, 0.0, 0.0])
    body = FreeBody(varied, lambda: current)
    body.release_at(0)
    ratios = []
    for second in range(5, 605, 5):
        field = body.motion(second * SECOND).field_body
        torque = body.orbit_truth().torques()["coils"]
        mean = np.cross(body.craft.coil_dipole @ current, field)
        ratios.append(np.linalg.norm(torque) / np.linalg.norm(mean))
    intervals = np.array(ratios).reshape(30, 4)
    assert np.ptp(intervals, axis=1).max() < 1e-9
    assert np.std(intervals[:, 0] - 1.0) == pytest.approx(0.02, rel=0.25)
    assert np.abs(intervals - 1.0).max() < np.sqrt(3.0) * 0.02


TENSOR = ((4.0e-3, 2.0e-4, -1.0e-4), (2.0e-4, 5.0e-3, 3.0e-4), (-1.0e-4, 3.0e-4, 6.0e-3))


def test_the_true_body_has_the_described_tensor_unless_it_is_given_another() -> None:
    config = as_orbit(reader.load(FOLDER / "orbit_3u.yaml"))
    config = reader.replace(config, craft=reader.replace(config.craft, inertia=TENSOR))
    calm = Disturbances(principal_turn_deg=0.0, coil_scale=0.0, coil_tilt_deg=0.0)
    size = (0.3, 0.1, 0.1)
    described = FreeBodySection(craft=CraftSection(size=size), disturbances=calm)
    body = FreeBody(described, lambda: np.zeros(3), craft=craft_model(described, config))
    np.testing.assert_allclose(inertia_matrix(body), TENSOR, rtol=1e-9)
    np.testing.assert_allclose(body.craft.coil_dipole, 1.351 * np.eye(3))
    own = FreeBodySection(craft=CraftSection(size=size, inertia=(1.0, 1.0, 1.5)), disturbances=calm)
    body = FreeBody(own, lambda: np.zeros(3), craft=craft_model(own, config))
    np.testing.assert_allclose(inertia_matrix(body), np.diag([1.0, 1.0, 1.5]))
    with pytest.raises(ConfigError, match=r"craft.inertia: has the principal moments 1, 1, 5: the largest"):
        craft_model(FreeBodySection(craft=CraftSection(size=size, inertia=(1.0, 1.0, 5.0))), config)
    with pytest.raises(ConfigError, match=r"craft.inertia: mixes numbers and rows"):
        craft_model(
            FreeBodySection(craft=CraftSection(size=size, inertia=(1.0, 1.0, (0.0, 0.0, 1.0)))), config
        )
    with pytest.raises(ConfigError, match="needs the configuration of a satellite"):
        FreeBody(described, lambda: np.zeros(3))


def test_the_true_residual_dipole_is_the_described_one_plus_the_disturbance() -> None:
    config = as_orbit(reader.load(FOLDER / "orbit_3u.yaml"))
    described = (2e-3, -1e-3, 0.0)
    config = reader.replace(config, craft=reader.replace(config.craft, residual_dipole=described))
    calm = Disturbances(residual_dipole=0.0)
    found = [
        FreeBody(section, lambda: np.zeros(3), craft=craft_model(section, config)).craft.constant_dipole
        for section in (
            FreeBodySection(craft=CraftSection(), disturbances=calm),
            FreeBodySection(craft=CraftSection()),
            FreeBodySection(craft=CraftSection(residual_dipole=(0.0, 0.0, 1e-3)), disturbances=calm),
        )
    ]
    np.testing.assert_allclose(found[0], described)
    assert np.linalg.norm(found[1] - described) == pytest.approx(1e-3)
    np.testing.assert_allclose(found[2], [0.0, 0.0, 1e-3])


@pytest.mark.parametrize(("name", "craft"), [("orbit.yaml", "knightcube"), ("orbit_3u.yaml", "cubesat_3u")])
def test_the_campaign_of_pointing_judges_the_weights_that_are_flown(name: str, craft: str) -> None:
    config, judged = as_orbit(reader.load(FOLDER / name)), WEIGHTS[craft]
    flown = config.pointing
    assert config.dipole_weight() == pytest.approx(judged.dipole, rel=0.01)
    for weight in ("turn", "rate", "roll"):
        assert getattr(flown, weight) == pytest.approx(getattr(judged, weight), rel=0.01), weight


def test_the_filter_expects_the_errors_of_tilted_coils_that_the_world_draws() -> None:
    """The errors of tilted coils that the world draws agree with the prior covariance of the filter.

    Over 200 satellites, the mean square of the errors of the coil matrix agrees with this covariance.
    """
    config = as_orbit(reader.load(FOLDER / "orbit_1u_tilted.yaml"))
    coils, prior = config.coils.map(), filter_settings(config).coils
    assert prior is not None
    text = (FOLDER / "orbit_1u_tilted.yaml").read_text(encoding="utf-8")
    section = reader.simulation_section(text, "orbit_1u_tilted.yaml", Simulation)
    assert section is not None
    assert section.free_body is not None
    squares = []
    for seed in range(200):
        errors = description_errors(config, reader.replace(section, seed=seed))
        generator = np.random.default_rng(seed)
        built = built_craft(section.free_body, generator, errors, craft_model(section.free_body, config))
        error = (coils.per_dipole(built.coil_dipole) - np.eye(3)).ravel()
        squares.append(float(error @ np.linalg.solve(prior, error)) / 9.0)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("release", "problem"),
    [
        (TipOff(attitude=(0.0, 0.0, 0.0, 0.0)), "release.attitude: has length 0"),
        (TipOff(rate=(0.0, 400.0, 0.0)), "release.rate: has 400 rad/s: give at most 35 rad/s"),
    ],
)
def test_an_impossible_release_is_refused(release: TipOff, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        free_body.released(release, np.random.default_rng(1))


def described_world(text: str) -> World:
    section = reader.simulation_section(text, "x.yaml", Simulation)
    assert section is not None
    return make_world(WorldInputs(reader.parse(text, "x.yaml"), section, lambda: np.zeros(3), 0))


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ("free_body: {disturbances: {drag: 1e300}}", "disturbances.drag"),
        (
            "free_body: {craft: {centre_of_mass: [0.06, 0.0, 0.0]}}",
            "centre_of_mass.*outside the box.*: give m",
        ),
        ("imu: {quaternion_noise: 2.0}", "quaternion_noise"),
        ("latency: {planner: 1e300}", "latency.planner"),
        ("sky: {readout: 1e300}", "sky.readout"),
    ],
)
def test_values_with_which_no_world_can_be_simulated_are_refused(values: str, problem: str) -> None:
    text = f"extends: orbit\nsimulation: {{{values}}}\n"
    with pytest.raises(ConfigError, match=problem):
        described_world(text)
