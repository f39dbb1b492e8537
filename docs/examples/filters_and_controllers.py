"""Detumble and point a simulated satellite, and check the estimates of its motion against the truth."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
from scipy.spatial.transform import Rotation

from knightcube import (
    AttitudeFilter,
    AttitudeFilterSettings,
    AttitudeMeasurement,
    Detumbler,
    DetumblerSettings,
    FieldRate,
    FieldRateSettings,
    Goal,
    PointingTarget,
    PointingWeights,
    RateMeasurement,
    RigidBody,
    WindowSchedule,
    attitude_error,
    check_consistency,
    magnetic_field,
    plan_pointing,
    propagate_elements,
)

ELEMENTS = (
    "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05",
    "2 99999  97.4640 337.4170 0011973 295.7805  64.3547 15.24067411    09",
)
BEGIN = datetime(2026, 3, 20, 12, 10, tzinfo=UTC)
INERTIA, LIMIT = np.diag([1.10e-3, 1.05e-3, 0.99e-3]), 0.1  # kg m^2, A m^2
GRID = np.arange(0.0, 1501.0, 10.0)
TIMES = [BEGIN + timedelta(seconds=float(second)) for second in GRID]
FIELDS = np.array(
    [magnetic_field(t, r) for t, r in zip(TIMES, propagate_elements(ELEMENTS, TIMES)[0], strict=True)]
)
RANDOM = np.random.default_rng(1)


def field(time: float) -> np.ndarray:
    """Return the magnetic field (3,), T, in ICRS axes at a time, s."""
    return np.array([np.interp(time, GRID, column) for column in FIELDS.T])


def body_axes(q: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return a vector (3,) of ICRS axes in the body axes of the attitude q."""
    return Rotation.from_quat(q).inv().apply(vector)


def moved(q: np.ndarray, w: np.ndarray, torque: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return attitude (4,) and rate (3,) after `dt` s, by the midpoint rule."""

    def change(rate: np.ndarray) -> np.ndarray:
        return np.linalg.solve(INERTIA, torque - np.cross(rate, INERTIA @ rate))

    middle = w + 0.5 * dt * change(w)
    turned = Rotation.from_quat(q) * Rotation.from_rotvec(dt * middle)
    return turned.as_quat(), w + dt * change(middle)


def detumble(q: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, FieldRate]:
    """Return the motion after 300 s of detumbling, and the filter that estimated the rate without a gyro."""
    windows = WindowSchedule(settle_ns=100_000_000, measure_ns=300_000_000, act_ns=600_000_000)
    settings = DetumblerSettings(inertia=0.99e-3, dipole_per_ampere=1.0, current_limit=LIMIT, share=0.3)
    detumbler, rates = (
        Detumbler(windows, settings),
        FieldRate(FieldRateSettings(inertia=INERTIA, field_sigma=1e-7, torque_walk=1e-6)),
    )
    for step in range(3000):
        time_ns = 100_000_000 * step
        here = body_axes(q, field(1e-9 * time_ns))
        if detumbler.listens(time_ns):
            measured = here + RANDOM.normal(0.0, 1e-7, 3)
            detumbler.sample(time_ns, measured)
            rates.measure(measured)
        dipole = detumbler.current(time_ns)  # with 1 A m^2 per A
        q, w = moved(q, w, np.cross(dipole, here), 0.1)
        rates.advance(dipole, 0.1)
    return q, w, rates


def across(q: np.ndarray, w: np.ndarray, time: float) -> float:
    """Return the rate (deg/s) across the field, which coils can reduce at this time."""
    here = body_axes(q, field(time))
    return float(np.degrees(np.linalg.norm(np.cross(w, here)) / np.linalg.norm(here)))


def estimate() -> tuple[np.ndarray, np.ndarray]:
    """Return the errors (6,) of attitude and rate after a random flight of 10 s, and their covariance."""
    q, w, sigma = Rotation.random(random_state=RANDOM).as_quat(), RANDOM.normal(0.0, 0.05, 3), 1e-3
    bias, variance = RANDOM.normal(0.0, 1e-3, 3), sigma**2 * np.eye(3)
    settings = AttitudeFilterSettings(
        current_noise=0.0, control_period=0.1, disturbance_walk=1e-6, disturbance_start=1e-5, bias_start=1e-3
    )
    body = AttitudeFilter(RigidBody(INERTIA, 1.0, field(0.0)), settings)
    for step in range(100):
        time_ns = 100_000_000 * step
        gyro = RateMeasurement(time_ns, w + bias + RANDOM.normal(0.0, sigma, 3), variance)
        seen = Rotation.from_quat(q) * Rotation.from_rotvec(RANDOM.normal(0.0, sigma, 3))
        stars = AttitudeMeasurement(time_ns, seen.as_quat(), variance)
        if step == 0:
            body.start(stars, gyro)
        else:
            body.measure(gyro)
            if step % 10 == 0:
                body.measure(stars)
        q, w = moved(q, w, np.zeros(3), 0.1)
    found = body.at(time_ns + 100_000_000)
    errors = np.concatenate([attitude_error(q, found.quaternion), w - found.rate])
    return errors, found.covariance[:6, :6]


def point(q: np.ndarray, w: np.ndarray) -> tuple[float, float]:
    """Return the pointing errors (deg) before and after 1,500 s of pointing to nadir."""
    law = plan_pointing(
        inertia=INERTIA,
        dipole_limit=[LIMIT] * 3,
        elements=ELEMENTS,
        time=BEGIN,
        target=PointingTarget(Goal.NADIR),
        quaternion=q,
        rate=w,
        weights=PointingWeights(turn=0.0175, rate=1.0, dipole=3e-4),
    )
    errors = []
    for time in np.arange(0.0, 1500.0, 1.0):
        here = body_axes(q, field(time))
        errors.append(attitude_error(q, law.wanted(time).quaternion))
        q, w = moved(q, w, np.cross(law.command(time, q, w, here).dipole, here), 1.0)
    return np.degrees(np.linalg.norm(errors[0])), np.degrees(np.linalg.norm(errors[-1]))


first, start = np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.06, -0.05, 0.08])  # rad/s
q, w, rates = detumble(first, start)
error = w - rates.rate
print(
    f"rate across field: {across(first, start, 0.0):.2f} deg/s before, {across(q, w, 300.0):.2f} deg/s after"
)
print(f"rate without gyro: {check_consistency([error], [rates.covariance[:3, :3]])}")
flights = [estimate() for _ in range(20)]
print(f"attitude filter:   {check_consistency(*zip(*flights, strict=True))}")
print("pointing error: {:.0f} deg before, {:.1f} deg after".format(*point(first, 0.02 * start)))
