"""Tests that `knightcube identify` of a satellite gives a configuration that is closer to the truth."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.schema.bodies import as_orbit
from flight.schema.devices import camera_model
from flight.schema.reader import load
from ground.identification.orbit import fragment, learned_description
from ground.telemetry import read_run
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.errors import InputError
from tests.ground.commands.in_process import command
from tests.support.packed_run import packed_run

TRUE = np.array([[0.0063, 0.0004, -0.0003], [0.0004, 0.0345, 0.0005], [-0.0003, 0.0005, 0.0320]])
WINDINGS = [
    {"axis": axis, "dipole_per_ampere": 1.18, "resistance": 9.13}
    for axis in ([1.0, 0.02, 0.0], [0.0, 1.0, -0.03], [0.0, 0.0, 1.0])
]
WORLD = f"""
simulation:
  free_body:
    craft: {{inertia: {TRUE.tolist()}, windings: {json.dumps(WINDINGS)}}}
    errors: 0.0
    release: {{speed: 0.1}}
"""


def fly(config: Path, folder: Path) -> None:
    done = command("run", config, "--out", folder)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a run, the output of the command, and the configuration fragment."""
    place = tmp_path_factory.mktemp("identify")
    config = place / "first.yaml"
    seen = "camera: {objects: null}\nwide_cameras: []"  # the run has no horizon cameras and no objects
    config.write_text(f"extends: orbit_3u\nname: first\nduration: 65.0\n{seen}\n{WORLD}")
    fly(config, place / "first")
    done = command("identify", place / "first", "--out", place / "learned.yaml", "--json")
    assert done.returncode == 0, done.stderr
    facts: dict[str, Any] = json.loads(done.stdout)
    return place, facts


def ratio_errors(folder: Path) -> list[float]:
    """Return the largest element error of J / trace(J) for each inertia in the log of a run.

    The first inertia comes from the configuration, and all later inertias are estimates from the flight.
    """
    elements = read_run(folder)["description"]["inertia"].astype(float)
    true = TRUE[(0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)] / np.trace(TRUE)
    found: list[float] = np.abs(elements / elements[:, :3].sum(axis=1)[:, None] - true).max(axis=1).tolist()
    return found


def test_a_flight_with_the_fragment_begins_where_the_last_one_ended(
    flown: tuple[Path, dict[str, Any]],
) -> None:
    place, _ = flown
    config = place / "second.yaml"
    config.write_text("extends: learned.yaml\nname: second\nduration: 11.0\n")
    fly(config, place / "second")
    first, second = ratio_errors(place / "first"), ratio_errors(place / "second")
    assert second[0] < 0.2 * first[0]
    assert second[0] < 5e-4


def test_the_fragment_states_the_truth_within_its_claims(flown: tuple[Path, dict[str, Any]]) -> None:
    place, facts = flown
    assert (place / "learned.yaml").read_text() == facts["fragment"]
    checked = command("check", place / "learned.yaml")
    assert "learned.yaml: first, valid" in checked.stdout
    config = as_orbit(load(place / "learned.yaml"))
    described = as_orbit(load(place / "first.yaml"))
    inertia, scale = config.craft.inertia_matrix(), np.trace(described.craft.inertia_matrix())
    assert np.trace(inertia) == pytest.approx(scale, rel=1e-6)
    error = inertia - TRUE / np.trace(TRUE) * scale
    assert np.abs(error).max() < 4.0 * max(facts["quantities"]["inertia"]["claim"])
    assert config.craft.accuracy.moments < 0.1 * described.craft.accuracy.moments
    assert config.craft.accuracy.axes_deg < described.craft.accuracy.axes_deg
    one = facts["quantities"]["inertia"]
    change = (np.array(one["value"]) - one["described"]) / one["claim"]
    np.testing.assert_allclose(one["change_sigmas"], change)
    assert not facts["quantities"]["sunlit_dipole"]["learned"]
    true = np.array([coil["axis"] for coil in WINDINGS], dtype=float)
    true *= 1.18 * scale / np.trace(TRUE) / np.linalg.norm(true, axis=1)[:, None]
    error = config.coils.map().dipoles - true.T
    assert np.abs(error).max() < 4.0 * 1.351 * max(facts["quantities"]["coils"]["claim"])
    assert np.abs(error).max() < 0.5 * np.abs(described.coils.map().dipoles - true.T).max()
    assert config.craft.accuracy.coil_gain < 0.5 * described.craft.accuracy.coil_gain


def test_the_table_names_each_value_and_what_was_not_learned(flown: tuple[Path, dict[str, Any]]) -> None:
    place, facts = flown
    done = command("identify", place / "first")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    (row,) = (line for line in lines if line.startswith("inertia zz"))
    assert f"{facts['quantities']['inertia']['value'][2]:.5g}" in row
    assert row.endswith("sigma")
    assert next(line for line in lines if line.startswith("dipole in sunlight x")).endswith("not learned")


def test_a_mistake_is_one_line(flown: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    place, _ = flown
    for words, complaint in (
        (["orbit"], "a satellite is identified from a run"),
        ([place / "first", "--picture", tmp_path / "x.png"], "--picture: draws the fit of a testbed flight"),
        ([place / "first", "--seed", "3"], "--seed"),
    ):
        done = command("identify", *words)
        assert done.returncode == 2
        assert complaint in done.stderr
        assert done.stderr.count("\n") == 1


def test_a_run_that_learned_nothing_is_refused() -> None:
    config = as_orbit(load(Path("config/orbit_3u.yaml")))
    with pytest.raises(InputError, match="holds no description packet"):
        learned_description(packed_run(), config)
    ignorant = {name: [1.0] * count for name, count in (("inertia_ratio", 6), ("coils_ratio", 9))}
    ignorant |= {"gyro": [1.0] * 9, "field": [1.0] * 9, "camera": [1.0] * 3, "field_bias": [1.0] * 3}
    ignorant |= {"gyro_bias": [1.0] * 3, "dipole": [1.0] * 3, "sunlit_dipole": [1.0] * 3}
    packet: dict[str, Any] = {f"{name}_sigma": values for name, values in ignorant.items()}
    packet |= {"inertia": [0.0066, 0.0333, 0.0333, 0.0, 0.0, 0.0]}
    with pytest.raises(InputError, match="fly longer"):
        learned_description(packed_run(description=[(10.0, packet)]), config)


def test_estimated_sensor_errors_are_combined_with_the_configured_ones(tmp_path: Path) -> None:
    config = tmp_path / "known.yaml"
    config.write_text(
        "extends: orbit_3u\ninertial_unit:\n  calibration:\n"
        "    gyro_matrix: [[1.01, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\n"
        "    field_matrix: [[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\n"
        "    field_bias: [1.0e-6, 0.0, 0.0]\n"
    )
    matrix = [1.0, 0.002, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    packet: dict[str, Any] = {
        "inertia": [0.0066, 0.0333, 0.0333, 0.0, 0.0, 0.0],
        "inertia_ratio_sigma": [1.0] * 6,
        "coils_ratio_sigma": [1.0] * 9,
        "gyro": matrix,
        "gyro_sigma": [1e-4] * 9,
        "field": matrix,
        "field_sigma": [1e-4] * 9,
        "field_bias": [0.0, 2e-6, 0.0],
        "field_bias_sigma": [1e-8] * 3,
        "camera": [0.0, 0.0, 1e-3],
        "camera_sigma": [1e-5] * 3,
        "dipole": [1e-3, 0.0, -2e-3],
        "dipole_sigma": [1e-4] * 3,
    }
    folder = tmp_path / "run"
    run = packed_run(folder, description=[(10.0, packet)])
    found = learned_description(run, as_orbit(load(config)))
    learned = tmp_path / "learned.yaml"
    learned.write_text(fragment(found, folder, "known.yaml"))
    flown = as_orbit(load(learned))
    known = flown.inertial_unit.calibration
    assert known.gyro_matrix[0] == pytest.approx((1.01, 1.01 * 0.002, 0.0))
    assert known.field_matrix[0] == pytest.approx((1.0, 0.102, 0.0))
    assert known.field_bias == pytest.approx((1e-6 + 0.1 * 2e-6, 2e-6, 0.0))
    assert flown.inertial_unit.accuracy.gyro_scale == pytest.approx(np.sqrt(3.0) * 1e-4, rel=0.01)
    assert flown.camera is not None
    before = as_orbit(load(config)).camera
    assert before is not None
    between = multiply(conjugate(np.array(before.mounting)), np.array(flown.camera.mounting))
    np.testing.assert_allclose(to_rotation_vector(between), [0.0, 0.0, 1e-3], atol=1e-8)
    assert flown.camera.accuracy.mounting_deg == pytest.approx(np.degrees(np.sqrt(3.0) * 1e-5), rel=0.01)
    assert flown.craft.residual_dipole == pytest.approx((1e-3, 0.0, -2e-3))
    assert flown.dipole_errors()[0] == pytest.approx(np.sqrt(3.0) * 1e-4, rel=0.01)
    assert flown.craft.accuracy.moments == as_orbit(load(config)).craft.accuracy.moments, "not learned"


def test_the_fragment_has_the_learned_lens_with_its_accuracy(flown: tuple[Path, dict[str, Any]]) -> None:
    """The fragment contains the estimated lens.

    The standard deviations of the lens come from the packet `lens` and are rounded up.
    """
    place, _ = flown
    config = as_orbit(load(place / "first" / "config.yaml"))
    found = learned_description(read_run(place / "first"), config)
    lens = {
        "frames": 12,
        "focal_length_px": [1460.0, 0.292],
        "centre_px": [255.0, 257.25],
        "centre_sigma_px": [0.125, 0.125],
        "distortion": [-0.05, 0.01],
        "corner_sigma": 4e-4,
        "line_time_s": [2.5e-5, 1e-7],
        "psf_sigma_px": [1.25, 0.01],
    }
    text = fragment(dataclasses.replace(found, lens=lens), place / "first", "first/config.yaml")
    (place / "lens.yaml").write_text(text)
    camera = as_orbit(load(place / "lens.yaml")).camera
    assert camera is not None
    assert camera.lens is not None
    assert (camera.lens.focal_length, camera.lens.centre, camera.lens.k1) == (1460.0, (255.0, 257.25), -0.05)
    accuracy = camera.accuracy
    stated = (accuracy.focal_length, accuracy.centre, accuracy.distortion, accuracy.line_time)
    assert stated == pytest.approx((2e-4, 0.125, 4e-4, 1e-7), rel=0.02)
    assert (camera.line_time, camera.psf_sigma) == (2.5e-5, 1.25)
    # The pixel of the configured optical axis keeps its direction in body axes.
    (place / "plain.yaml").write_text(fragment(found, place / "first", "first/config.yaml"))
    plain = as_orbit(load(place / "plain.yaml")).camera
    assert plain is not None
    pixel = np.array([camera_model(plain).centre])
    shown = [
        attitude_matrix(np.array(one.mounting)).T @ camera_model(one).unit_vectors(pixel)[0]
        for one in (plain, camera)
    ]
    assert np.allclose(shown[0], shown[1], atol=1e-7)
