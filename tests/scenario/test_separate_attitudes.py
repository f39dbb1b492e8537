"""Runs an ION-F satellite with two cameras for a few seconds and checks the separate attitudes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
from flight.schema.document import FOLDER
from knightcube.astro.quaternion import angle_between
from sim_hal.settings import Simulation
from tests.support.flights import fly
from tests.support.sensor_suite import load

SATELLITES = {"uw": "ionf", "vt": "ionf_vt", "usu": "ionf_usu"}
METHODS = ("cameras", "fused", "filtered", "flown")
SECONDS, SETTLED, PIXELS = 6.0, 3.0, 320


@pytest.mark.parametrize("name", SATELLITES)
def test_each_satellite_flies_the_cameras_of_its_sensor_file(name: str) -> None:
    suite = load(FOLDER / "sensors" / f"{name}.yaml")
    flown = as_orbit(configuration.load(FOLDER / f"{SATELLITES[name]}.yaml"))
    assert flown.craft.mass == 15.0
    assert flown.craft.inertia == suite.inertia
    assert len(flown.wide_cameras) == len(suite.cameras)
    for camera, wanted in zip(flown.wide_cameras, suite.cameras, strict=True):
        assert camera.mounting == pytest.approx(wanted.mounting, abs=1e-8)
        assert (camera.columns, camera.rows, camera.sun) == (wanted.columns, wanted.rows, wanted.sun)
        assert (camera.field_of_view_deg, 1.0 / camera.period) == (67.0, suite.camera_rate_hz)


def test_cameras_and_magnetometer_give_attitudes_in_addition_to_the_one_in_use(tmp_path: Path) -> None:
    path = FOLDER / "ionf.yaml"
    config = as_orbit(configuration.load(path))
    small = tuple(
        configuration.replace(one, columns=PIXELS, rows=PIXELS, lens_error_deg=0.1)
        for one in (config.wide_cameras[0], config.wide_cameras[2])
    )
    config = configuration.replace(config, wide_cameras=small, duration=SECONDS)
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    run = fly(config, tmp_path / "flown", section=section)
    rows = run["separate_attitudes"]
    assert len(rows) >= 3, "about two rounds a second once the first fix gives the position"
    assert np.median(np.diff(rows["middle_ns"])) == pytest.approx(0.5e9, abs=0.03e9)
    rows = rows[rows["middle_ns"] > SETTLED * 1e9]
    truth = run["truth"]
    nearest = truth["quaternion"][np.searchsorted(truth["time_ns"], rows["middle_ns"])]
    for method in METHODS:
        known = np.isfinite(rows[method][:, 0])
        assert known.mean() > (0.9 if method == "cameras" else 0.5)
        square = angle_between(rows[method][known], nearest[known]) ** 2 / 3.0
        claim = rows[f"{method}_sigma"][known].astype(float) ** 2
        assert square.mean() < min(np.radians(2.0) ** 2, 16.0 * claim.mean())
    assert not np.isfinite(rows["magnetometer"]).any(), "the field has hardly turned in some seconds"
