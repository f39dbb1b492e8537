"""Diagnosis of a first bench session: noise and rate of the inertial unit, its axes, and the coils.

The coils are compared by the field that each coil produces at the magnetometer per ampere, in both directions
of the current, and by the current that the supply delivers. The measured response of each coil is compared
with the expected response of every coil, so that swapped, reversed and weak coils are distinguished. The axes
of gyro, accelerometer and magnetometer are determined from right-handed rotations of 90 deg by hand about
each body axis. Before each rotation by hand the body z axis points up. Angle and axis of a rotation by hand
are accurate to about 15 deg, so that only swapped and reversed axes and large misalignments are found.
Rotations do not determine the common sign of the magnetometer's axes; the coils determine this sign.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, linear_sum_assignment

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.quaternion import (
    attitude_matrix,
    from_matrix,
    from_rotation_vector,
    to_rotation_vector,
)

QUARTER = 0.5 * math.pi
"""Angle (rad) of the rotation by hand about each body axis."""
GRAVITY = 9.80665
"""Standard gravity (m/s^2)."""
RECOGNISED = math.radians(25.0)
"""Largest angle (rad) at which a measured direction is assigned to an expected direction."""
ASKEW = math.radians(15.0)
"""Largest accepted angle (rad) between a coil's expected and measured field if the sensor axes are exact."""
FEWEST = 20
"""Smallest number of samples from which the noise is determined."""
ALIKE = math.radians(15.0)
"""Largest angle (rad) between the axes of two sensors that count as equally mounted."""
SCALE = 0.1
"""Largest relative difference between the scales of two axes or sensors that count as equal."""
STRONGEST_BIAS = 1.5e-5
"""Largest constant field (T) of the body itself that is permitted even if the field of the site is weak."""
_AXES = "xyz"
_NEAR = 0.15  # relative difference up to which a measured value agrees with its expected value
UNRECOGNISED = "different from the configuration, cause unknown"


@dataclass(frozen=True, slots=True)
class Finding:
    """One diagnosed fault of a device.

    Attributes:
        part: section of the configuration, for example `coils.windings[0]`.
        kind: kind of the fault in one or two words, for example `reversed`.
        text: measured value and its meaning.
        cure: remedy.
        factor: ratio of actual to configured resistance of a coil, or None.
        setting: configuration key of the part and its measured value, such as a baud rate, or None.
    """

    part: str
    kind: str
    text: str
    cure: str
    factor: float | None = None
    setting: tuple[str, int] | None = None

    def line(self) -> str:
        """Return the finding as one line."""
        return f"{self.part}: {self.kind}: {self.text}: {self.cure}"


def signed_permutations() -> list[FloatArray]:
    """Return the 48 matrices (3, 3) that permute and reverse axes, beginning with the identity."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            found.append(matrix)
    return found


def axis_names(matrix: FloatArray) -> str:
    """Return a text that names the body axis measured by each wrong axis, such as `x shows -y, y shows x`."""
    shown = []
    for name, row in zip(_AXES, matrix, strict=True):
        index = int(np.argmax(np.abs(row)))
        other = f"{'-' if row[index] < 0 else ''}{_AXES[index]}"
        if other != name:
            shown.append(f"{name} shows {other}")
    return ", ".join(shown)


# Inertial unit at rest and during rotations by hand.


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Readings of the inertial unit: `times` (k,), s, and rate, field and acceleration (k, 3), body axes."""

    times: FloatArray
    rate: FloatArray
    field: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True, slots=True)
class UnitExpectation:
    """Expected sample rate (Hz) and noise of a sample: gyro (rad/s), field (T) and acceleration (m/s^2)."""

    rate_hz: float
    gyro: float
    field: float
    acceleration: float


def noise_of(values: FloatArray) -> FloatArray:
    """Return the standard deviations (3,) of the white noise of values (k, 3), without slow drifts."""
    return np.asarray(np.std(np.diff(values, axis=0), axis=0) / math.sqrt(2.0))


def missing_share(change: FloatArray, noise: float) -> float:
    """Return the fraction of samples in which the coil produced no field.

    The coil changes the measured field by `change` (k, 3), T. The field of the coil is missing in a sample if
    the change is less than half of the typical change (80th percentile). The fraction is 0 if the typical
    change is at most eight times the `noise` (T) of a sample.
    """
    mean = change.mean(axis=0)
    along = change @ mean / (np.linalg.norm(mean) or 1.0)
    full = float(np.quantile(along, 0.8))
    return float(np.mean(along < 0.5 * full)) if full > 8.0 * noise else 0.0


def allan_deviation(values: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    """Return averaging times (m,), s, and the Allan deviations (m, 3) of values (k, 3) every `period` s."""
    sizes = [1 << n for n in range(int(math.log2(max(len(values) // 4, 1))) + 1)]
    found = []
    for size in sizes:
        means = values[: len(values) // size * size].reshape(-1, size, 3).mean(axis=1)
        found.append(np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0)))
    return period * np.array(sizes), np.array(found)


def diagnose_rest(
    samples: Samples, span: float, expected: UnitExpectation, bad: float, strongest: float
) -> list[Finding]:
    """Return the faults of an inertial unit that was at rest for `span` s.

    `bad` is the fraction of packets with a wrong checksum, `strongest` the strongest field (T) of the site.
    """
    found, part = [], "inertial_unit"
    if bad > 0.01:
        text = f"{100.0 * bad:.1f} % of the packets have a wrong checksum"
        cure = "check the ground wire and the length of the cable, or lower the baud rate"
        found.append(Finding(part, "corrupted packets", text, cure))
    measured = len(samples.times) / span
    gaps = np.diff(samples.times)
    if bad <= 0.01 and len(gaps) > FEWEST and gaps.max() > 4.0 * max(np.median(gaps), 1.0 / expected.rate_hz):
        text = f"the samples stop {int(np.sum(gaps > 0.5 * gaps.max()))} times, for up to {gaps.max():.2f} s"
        cure = "check plugs and solder joints for loose contact, and its supply"
        found.append(Finding(part, "intermittent", text, cure))
    elif abs(measured / (expected.rate_hz * max(1.0 - bad, 0.01)) - 1.0) > 0.05:
        text = f"{measured:.1f} valid samples per second arrive instead of {expected.rate_hz:g}"
        cure = "check `rate_hz`, the baud rate, which limits the samples, and the cable"
        found.append(Finding(part, "wrong rate", text, cure))
    if len(samples.times) < FEWEST:
        return found
    quantities = (
        ("gyro", samples.rate, expected.gyro, "rad/s"),
        ("magnetometer", samples.field, expected.field, "T"),
        ("accelerometer", samples.acceleration, expected.acceleration, "m/s^2"),
    )
    for name, values, sigma, unit in quantities:
        repeated = float(np.mean((np.diff(values, axis=0) == 0.0).all(axis=1)))
        if 0.2 < repeated < 0.98:
            new = measured * (1.0 - repeated)
            text = f"{100.0 * repeated:.0f} % of its values repeat: {new:.3g} are new per second"
            cure = "set the output rate of the sensor to `rate_hz` or more"
            found.append(Finding(f"{part}.{name}", "wrong rate", text, cure))
        else:
            found += _noise_findings(f"{part}.{name}", values, sigma, unit)
    return found + _rest_values(samples, strongest)


def _noise_findings(part: str, values: FloatArray, sigma: float, unit: str) -> list[Finding]:
    noise = noise_of(values)
    if not np.isfinite(values).all():
        return [Finding(part, "dead", "it sends values that are not numbers", "replace the sensor")]
    if noise.max() > 3.0 * sigma:
        axis = _AXES[int(np.argmax(noise))]
        text = f"noise {noise.max():.2g} {unit} on {axis}, expected {sigma:.2g}"
        cure = "keep the unit still and away from supplies and fans; replace the unit if the noise stays"
        return [Finding(part, "noisy", text, cure)]
    if noise.min() < 1e-3 * sigma:
        axes = ", ".join(axis for axis, value in zip(_AXES, noise, strict=True) if value < 1e-3 * sigma)
        text = f"its values on {axes} do not change: noise {noise.min():.1e} {unit}, expected {sigma:.2g}"
        cure = "switch the unit off and on; replace it if the values still do not change"
        return [Finding(part, "stuck", text, cure)]
    return []


def _rest_values(samples: Samples, strongest: float) -> list[Finding]:
    found, part = [], "inertial_unit"
    bias = samples.rate.mean(axis=0)
    if np.abs(bias).max() > 0.02:
        text = f"it measures {np.abs(bias).max():.3f} rad/s at rest"
        cure = "keep the body still and repeat the step; calibrate the gyro if the bias stays"
        found.append(Finding(f"{part}.gyro", "biased", text, cure))
    force = float(np.linalg.norm(samples.acceleration.mean(axis=0)))
    if np.isfinite(force) and abs(force / GRAVITY - 1.0) > 0.05:
        text = f"it measures {force:.2f} m/s^2 at rest instead of {GRAVITY:.2f}"
        cure = "check the range and the unit of its driver"
        found.append(Finding(f"{part}.accelerometer", "wrong scale", text, cure))
    field = float(np.linalg.norm(samples.field.mean(axis=0)))
    if np.isfinite(field) and not 1.5e-5 <= field <= strongest:
        text = f"it measures {1e6 * field:.3g} uT at rest, expected are 15 to {1e6 * strongest:.0f} uT"
        cure = "check the unit and the range of its driver, and remove magnets and iron"
        found.append(Finding(f"{part}.magnetometer", "wrong scale", text, cure))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Measurements of the rotations by hand about x, y and z; the first index is the axis of rotation.

    Attributes:
        gyro: rotation vectors (3, 3) measured by the gyro, rad.
        before, after: mean acceleration and mean field before and after each rotation (3, 2, 3); the second
            index is 0 for the acceleration and 1 for the field.
    """

    gyro: FloatArray
    before: FloatArray
    after: FloatArray


def turned(samples: Samples, bias: FloatArray) -> FloatArray:
    """Return the integral (3,), rad, of the gyro's rate less its `bias` (3,), rad/s.

    For a rotation about a fixed axis, the integral is the rotation vector, also beyond 180 deg.
    """
    steps = np.diff(samples.times)[:, None]
    return np.asarray(np.sum((samples.rate[1:] - bias) * steps, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class AxesFound:
    """Axes of each sensor: orthogonal matrix (3, 3) from body axes to measured axes, or None if unknown."""

    gyro: FloatArray | None
    accelerometer: FloatArray | None
    magnetometer: FloatArray | None
    findings: list[Finding]


def diagnose_axes(turns: Turns) -> AxesFound:
    """Return the axes of gyro, accelerometer and magnetometer from the rotations about x, y and z."""
    findings: list[Finding] = []
    gyro = _gyro_axes(turns.gyro, findings)
    if gyro is not None and not findings:
        findings += _gyro_scale(turns)
    axes: dict[str, FloatArray | None] = {"gyro": gyro}
    # If the gyro's scale is right, its angles are more accurate than the nominal angles of the rotations.
    vectors = QUARTER * np.eye(3) if gyro is None or findings else turns.gyro @ gyro
    rotations = [attitude_matrix(from_rotation_vector(vector)) for vector in vectors]
    up = np.array([0.0, 0.0, 1.0])
    force = np.concatenate([turns.before[:, 0], turns.after[:, 0]]) / GRAVITY
    named: list[Finding] = []
    if np.isfinite(force).all():
        axes["accelerometer"] = _orthogonal(force, np.array([up] * 3 + [one @ up for one in rotations]))
        if axes["accelerometer"] is None:
            named += _force_scales(force)
    if np.isfinite(turns.before[:, 1]).all() and np.isfinite(turns.after[:, 1]).all():
        field = _fitted_field(turns.before[:, 1], turns.after[:, 1], rotations, gyro)
        axes["magnetometer"] = field.axes
        named += _field_faults(field)
    for index, name in enumerate(("accelerometer", "magnetometer")):
        part, size = f"inertial_unit.{name}", float(np.linalg.norm(turns.before[0, index]))
        if name in axes and np.abs(turns.after[:, index] - turns.before[:, index]).max() < 0.02 * size:
            axes[name] = None
            text = "its values do not change during the rotations"
            findings.append(Finding(part, "stuck", text, "switch the unit off and on, or replace it"))
        elif own := [one for one in named if one.part == part]:
            findings += own
        elif name in axes and axes[name] is None:
            text = f"its axes, found by the rotations, are {UNRECOGNISED}"
            cure = "repeat the rotations by exactly 90 deg, away from iron"
            findings.append(Finding(part, "wrong axes", text, cure))
    found = {name: _nearest(matrix) for name, matrix in axes.items() if matrix is not None}
    common = _common(found)
    if common is not None:
        found = dict.fromkeys(found, common)
        if not _is_identity(common):
            findings.append(_wrong_axes("inertial_unit", common))
    else:
        wrong = {name: matrix for name, matrix in found.items() if not _is_identity(matrix)}
        findings += [_wrong_axes(f"inertial_unit.{name}", matrix) for name, matrix in wrong.items()]
    return AxesFound(found.get("gyro"), found.get("accelerometer"), found.get("magnetometer"), findings)


def _common(found: dict[str, FloatArray]) -> FloatArray | None:
    """Return the common axes of all sensors, or None if they differ. The magnetometer's sign is ignored."""
    if "gyro" not in found:
        return None
    first = found["gyro"]
    agree = [
        min(_angle(matrix, first), _angle(-matrix, first) if name == "magnetometer" else math.pi) <= ALIKE
        for name, matrix in found.items()
    ]
    return first if len(found) > 1 and all(agree) else None


def _wrong_axes(part: str, axes: FloatArray) -> Finding:
    whole, proper = part == "inertial_unit", np.linalg.det(axes) > 0
    sensors = "the axes of all sensors are wrong" if whole else "its axes differ from the body's"
    if not np.allclose(np.abs(axes).max(axis=1), 1.0):
        vector = -to_rotation_vector(from_matrix(axes if proper else -axes))
        about = ", ".join(f"{value:.2f}" for value in vector / np.linalg.norm(vector))
        text = f"{sensors}: rotated by {math.degrees(float(np.linalg.norm(vector))):.0f} deg about ({about})"
    else:
        text = f"{sensors}: {axis_names(axes)}"
    if whole and proper:
        cure = "set `mounting` as in the fragment, or mount the unit as configured"
    elif proper or not whole:
        cure = "correct `sensors[].measures`; reset registers 23 and 26 of a VN-100 to the identity"
    else:
        cure = "correct the axes in the driver: they are mirrored, which no mounting can cause"
    return Finding(part, "rotated" if proper else "mirrored", text, cure)


def _is_identity(axes: FloatArray) -> bool:
    return bool(np.allclose(axes, np.eye(3)))


def _angle(first: FloatArray, second: FloatArray) -> float:
    """Return the angle (rad) between two orthogonal matrices, or pi if only one of them is a reflection."""
    product = first @ second.T
    if np.linalg.det(product) < 0:
        return math.pi
    return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(product)) - 1.0))))


def _nearest(axes: FloatArray) -> FloatArray:
    """Return the signed permutation near an orthogonal matrix, or the matrix itself if none is near."""
    best = min(signed_permutations(), key=lambda matrix: _angle(matrix, axes))
    return best if _angle(best, axes) <= RECOGNISED else axes


def _orthogonal(measured: FloatArray, true: FloatArray) -> FloatArray | None:
    """Return the orthogonal matrix from true to measured unit vectors (k, 3), or None if the fit is poor."""
    left, _, right = np.linalg.svd(measured.T @ true)
    found = left @ right
    return found if np.linalg.norm(measured - true @ found.T, axis=1).max() <= RECOGNISED else None


def _gyro_axes(measured: FloatArray, findings: list[Finding]) -> FloatArray | None:
    """Return the gyro's axes from its rotation vectors (3, 3), or add a finding and return None."""
    part, sizes = "inertial_unit.gyro", np.linalg.norm(measured, axis=1)
    if not np.isfinite(sizes).all():
        text = "its rates are not numbers, or outside its range"
        cure = "check the unit of its driver (deg/s or rad/s), or replace the gyro"
        findings.append(Finding(part, "dead", text, cure))
        return None
    if (sizes < 0.2 * QUARTER).any():
        cure = "repeat the rotation; replace the gyro if this recurs"
        for axis in np.flatnonzero(sizes < 0.2 * QUARTER):
            degrees = math.degrees(sizes[axis])
            text = f"a rotation of 90 deg about {_AXES[axis]} is measured as {degrees:.1f} deg"
            findings.append(Finding(part, "dead", text, cure))
        return None
    ratio = sizes / QUARTER
    if (np.abs(np.log(ratio)) > math.log(1.35)).any():
        shown = ", ".join(f"{axis} {value:.2f}" for axis, value in zip(_AXES, ratio, strict=True))
        text = f"ratio of measured to requested angle: {shown}"
        cure = (
            "rotate by 90 deg; if the ratio stays, check the range and the unit (deg/s, rad/s) of the driver"
        )
        findings.append(Finding(part, "wrong scale", text, cure))
    found = _orthogonal(measured / sizes[:, None], np.eye(3))
    if found is None:
        text = f"the axes of its rates, found by the rotations, are {UNRECOGNISED}"
        findings.append(Finding(part, "wrong axes", text, "repeat the rotations about the requested axes"))
    return found


def _gyro_scale(turns: Turns) -> list[Finding]:
    """Return a finding if the gyro's angles about x and y differ from the angles computed from gravity.

    Both angles describe the same rotation, so a deviation of the rotation from 90 deg does not matter.
    """
    first, second = turns.before[:2, 0], turns.after[:2, 0]
    sizes = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    if not np.isfinite(sizes).all() or np.abs(np.sqrt(sizes) / GRAVITY - 1.0).max() > SCALE:
        return []
    angles = np.arccos(np.clip(np.sum(first * second, axis=1) / sizes, -1.0, 1.0))
    ratio = np.linalg.norm(turns.gyro[:2], axis=1) / np.maximum(angles, 0.2 * QUARTER)
    if np.abs(ratio - 1.0).max() <= SCALE:
        return []
    text = f"ratio of its angles to those from gravity: x {ratio[0]:.2f}, y {ratio[1]:.2f}"
    cure = "check the range of its driver, and calibrate its scale"
    return [Finding("inertial_unit.gyro", "wrong scale", text, cure)]


def _wrong_scales(part: str, scales: FloatArray, what: str) -> Finding:
    """Return the finding about a sensor whose axes have different or wrong scales (3,)."""
    shown = ", ".join(f"{axis} {value:.2f}" for axis, value in zip(_AXES, scales, strict=True))
    cure = "check range and unit of each axis in its driver, and calibrate its scale"
    return Finding(part, "wrong scale", f"{what}: {shown}", cure)


def _force_scales(force: FloatArray) -> list[Finding]:
    """Return a finding if the scales of an accelerometer are wrong, given its specific forces (k, 3), g.

    Each axis of a healthy sensor is vertical before or after one of the rotations.
    """
    sizes = np.abs(force).max(axis=0)
    if sizes.min() < 0.1 or np.abs(sizes - 1.0).max() <= 2.0 * SCALE:
        return []
    return [_wrong_scales("inertial_unit.accelerometer", sizes, "ratio of its largest values to gravity")]


def _field_faults(field: FieldFound) -> list[Finding]:
    """Return the magnetometer fault that the fit shows, if any: wrong scales, or a large constant field."""
    part = "inertial_unit.magnetometer"
    if field.scales is not None:
        return [_wrong_scales(part, field.scales, "relative scales")]
    if field.axes is None or field.bias <= max(0.4 * field.size, STRONGEST_BIAS):
        return []
    text = f"the body's own field is {1e6 * field.bias:.0f} uT, the site's {1e6 * field.size:.0f} uT"
    cure = "remove magnets, iron and currents near it; calibrate its bias if they belong to the body"
    return [Finding(part, "biased", text, cure)]


@dataclass(frozen=True, slots=True, eq=False)
class FieldFound:
    """Result of a fit of the magnetometer's values before and after the rotations.

    Attributes:
        axes: orthogonal matrix (3, 3) from body axes to measured axes, or None if no orthogonal matrix
            explains the values.
        size, bias: magnitudes of the site's field and of the body's constant field, T.
        scales: scale factors (3,) of the measured axes relative to their median, or None if they are equal.
    """

    axes: FloatArray | None
    size: float
    bias: float
    scales: FloatArray | None = None


def _fitted_field(
    before: FloatArray, after: FloatArray, turns: Sequence[FloatArray], gyro: FloatArray | None
) -> FieldFound:
    """Return the magnetometer's axes from fields (3, 3) before and after the rotations, with an unknown bias.

    The fit starts from the best signed permutation of the axes and from the axes of the gyro. The common sign
    is undetermined: of two matrices with opposite signs, the matrix closer to the identity is returned. The
    axes in the result are None if no matrix explains the fields.
    """
    values = np.concatenate([*before, *after])

    def unknowns(axes: FloatArray, scales: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (k, 3), and the field and the bias (6,), for given axes and scales."""
        rows = [np.hstack([np.eye(3), np.eye(3)])] * 3
        rows += [np.hstack([axes @ turn @ axes.T, np.eye(3)]) for turn in turns]
        matrix, scaled = np.vstack(rows), values / np.tile(scales, 6)
        found: FloatArray = np.asarray(np.linalg.lstsq(matrix, scaled, rcond=None)[0], dtype=float)
        return matrix @ found - scaled, found

    def solved(axes: FloatArray) -> tuple[FloatArray, float]:
        """Return the residuals and the magnitude of the field for given axes."""
        residuals, found = unknowns(axes, np.ones(3))
        return residuals, float(np.linalg.norm(found[:3]))

    def rotated(vector: FloatArray, start: FloatArray) -> FloatArray:
        return np.asarray(attitude_matrix(from_rotation_vector(vector)) @ start)

    def refined(start: FloatArray) -> FloatArray:
        size = solved(start)[1] or 1.0
        fit = least_squares(lambda vector: solved(rotated(vector, start))[0] / size, np.zeros(3), x_scale=0.1)
        return rotated(fit.x, start)

    def misfit(axes: FloatArray) -> float:
        return float(np.sum(solved(axes)[0] ** 2))

    proper = sorted((one for one in signed_permutations() if np.linalg.det(one) > 0), key=misfit)
    found = min((refined(start) for start in (proper[0], gyro) if start is not None), key=misfit)
    residuals, size = solved(found)
    if gyro is not None and np.linalg.norm(residuals) > 0.3 * SCALE * size:
        axes = _nearest(gyro)

        def relative(logs: FloatArray) -> FloatArray:
            return np.asarray(np.exp(np.array([*logs, -float(logs.sum())])))

        fit = least_squares(lambda logs: unknowns(axes, relative(logs))[0] / (size or 1.0), np.zeros(2))
        scales = relative(fit.x)
        better = np.linalg.norm(fit.fun) * size < 0.3 * np.linalg.norm(residuals)
        if better and scales.min() > SCALE and np.ptp(np.log(scales)) > 2.0 * SCALE:
            return FieldFound(None, size, 0.0, scales / np.median(scales))
    bias = float(np.linalg.norm(unknowns(found, np.ones(3))[1][3:]))
    if not size or np.linalg.norm(residuals.reshape(-1, 3), axis=1).max() > RECOGNISED * size:
        return FieldFound(None, size, bias)
    return FieldFound(found if np.trace(found) >= 0.0 else -found, size, bias)


# Coils.


@dataclass(frozen=True, slots=True, eq=False)
class CoilTest:
    """The measurements of n coils that were driven one after the other.

    Attributes:
        commanded: current of each coil (n,), A.
        plus, minus: field change per ampere (n, 3), T/A, for a positive and for a negative current.
        current: increase of the supply current (n, 2), A, for both directions; NaN without a monitor.
        idle: supply current (A) without a command; NaN without a monitor.
        noise: standard deviation of a field change per ampere, T/A.
        absent: fraction of the samples (n, 2) in which the field of the driven coil was missing.
        fault: text of a failed command to the coils, or an empty text.
        clipped: whether a current exceeded the range of the monitor.
        volts: supply voltage (V) without a command, and the lowest supply voltage with a command; NaN without
            a monitor.
        sensed: whether the magnetometer works; if not, only the currents of the coils are evaluated.
        rotation: largest rotation (rad) of the body between the recordings without and with a current.
        ambient: strength (T) of the field without a current.
    """

    commanded: FloatArray
    plus: FloatArray
    minus: FloatArray
    current: FloatArray
    idle: float
    noise: float
    absent: FloatArray
    fault: str = ""
    clipped: bool = False
    volts: tuple[float, float] = (math.nan, math.nan)
    sensed: bool = True
    rotation: float = 0.0
    ambient: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CoilsFound:
    """Result of the coil test.

    Attributes:
        response, expected: measured and expected field of each command (n, 3), T/A, in body axes.
        serves: index (n,) of the configured coil that each command drives, or -1 if the command produces no
            magnetic field.
        strength: ratio (n,) of the field of each command to the expected field of the coil that the command
            drives; negative if reversed.
        misfit: angle (n,), rad, between the axes of measured and expected field, from 0 to pi / 2.
        live: mask (n,) of the commands that produce a field.
        drawn: supply current (n,) relative to the command, corrected for a wrong shunt; NaN if unknown.
        shunt: ratio of actual to configured shunt resistance, or 1.
        joined: for each command j that drives two connected coils, the second coil k.
        askew: largest angle (rad) between the measured and the expected field of a healthy coil.
        findings: the faults.
    """

    response: FloatArray
    expected: FloatArray
    serves: list[int]
    strength: FloatArray
    misfit: FloatArray
    live: BoolArray
    drawn: FloatArray
    shunt: float
    joined: dict[int, int]
    askew: float
    findings: list[Finding]


def diagnose_coils(
    test: CoilTest,
    expected: FloatArray,
    names: Sequence[str],
    magnetometer: FloatArray | None = None,
    *,
    size_known: bool = True,
) -> CoilsFound:
    """Return the faults of the coils, given the expected field (n, 3), T/A, of each coil in body axes.

    The matrix `magnetometer` (3, 3) maps body axes to measured axes; its sign may be wrong. If `size_known`
    is false, the expected field strength per ampere is unknown, and the median of all coils is used instead.
    """
    axes = np.eye(3) if magnetometer is None else magnetometer
    plus, minus = test.plus @ axes, test.minus @ axes  # rows in body axes
    response = 0.5 * (plus + minus)
    size = np.linalg.norm(response, axis=1)
    if not size_known:
        expected = expected * _usual_size(response, expected)
    live = size > np.maximum(0.12 * np.linalg.norm(expected, axis=1), 6.0 * test.noise)
    live &= test.sensed
    serves, strength, misfit = _match(response, expected, live)
    sign, found = _common_sign(strength, misfit, live)
    drawn = np.mean(test.current, axis=1) / test.commanded
    joined = _joined(response, expected, live)
    exact = np.allclose(np.abs(axes).max(axis=1), 1.0, atol=1e-6)  # whether every axis is a body axis
    askew, strength = ASKEW if exact else RECOGNISED, sign * strength
    state = CoilsFound(response, expected, serves, strength, misfit, live, drawn, 1.0, joined, askew, found)
    if moved := _moved(test):
        return replace(state, findings=moved)
    shared, shunt = _shared_fault(test, state, size_known)
    # A monitor that measures no current gives no information about single coils.
    unmeasured = any(one.kind == "no current" for one in shared)
    state = replace(state, drawn=np.full_like(drawn, math.nan) if unmeasured else drawn / shunt, shunt=shunt)
    found += shared
    if not any(one.kind in _OF_ALL_COILS for one in shared):
        legs = np.linalg.norm(np.stack([plus, minus], axis=1), axis=2)
        for j in range(len(names)):
            found += _coil_findings(state, j, names, legs[j], float(test.absent[j].max()))
    return state


def _usual_size(response: FloatArray, expected: FloatArray) -> float:
    """Return the median strength (T/A) of those fields (n, 3) that are along the expected field of a coil."""
    size = np.linalg.norm(response, axis=1)
    unit = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    along = np.abs(response @ unit.T).max(axis=1) > math.cos(RECOGNISED) * size
    usual = along & (size >= 0.2 * size.max())
    return float(np.median(size[usual] if usual.any() else size[size >= 0.2 * size.max()]) or 1.0)


def _joined(response: FloatArray, expected: FloatArray, live: BoolArray) -> dict[int, int]:
    """Return the pairs (j, k) of coils for which command j produces the fields of both coils.

    Coils whose expected fields are nearly parallel are omitted, because their shares cannot be separated.
    """
    found, size = {}, np.linalg.norm(response, axis=1)
    units = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    parallel = np.abs(units @ units.T) > math.cos(RECOGNISED)
    for j in np.flatnonzero(live).tolist():
        for k in range(len(response)):
            alike = abs(float(response[j] @ response[k])) > math.cos(ASKEW) * size[j] * size[k]
            if parallel[j, k] or (live[k] and not alike):
                continue
            pair = expected[[j, k]].T
            shares, *_ = np.linalg.lstsq(pair, response[j], rcond=None)
            fits = np.linalg.norm(pair @ shares - response[j]) < math.sin(ASKEW) * size[j]
            if fits and np.abs(shares).min() > 0.25:
                found[j] = k
    return found


_OF_ALL_COILS = {"no field", "no supply", "no response", "wrong supply voltage", "sagging supply"}
"""Kinds of shared faults after which single coils are not evaluated."""


def _common_sign(strength: FloatArray, misfit: FloatArray, live: BoolArray) -> tuple[float, list[Finding]]:
    """Return the magnetometer's sign (-1 if the fields of all coils are reversed), with its finding."""
    count = int(live.sum())
    if count < 2 or (strength[live] > 0).any() or (misfit[live] > RECOGNISED).any():
        return 1.0, []
    text = f"the fields of all {count} coils are opposite"
    cure = "reverse the magnetometer's axes; or set `sign: -1` for all coils if all are wound the other way"
    return -1.0, [Finding("inertial_unit.magnetometer", "reversed sign", text, cure)]


def _match(
    response: FloatArray, expected: FloatArray, live: BoolArray
) -> tuple[list[int], FloatArray, FloatArray]:
    """Return driven coil, ratio of measured to expected field, and angle error (rad) of each command (n,)."""
    count = len(response)
    unit = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    length = np.linalg.norm(response, axis=1, keepdims=True)
    cosine = response / np.where(length > 0.0, length, 1.0) @ unit.T
    own = 0.05 * np.eye(count)  # parallel coils then do not count as swapped
    rows = np.flatnonzero(live)
    serves, strength, misfit = [-1] * count, np.zeros(count), np.full(count, math.pi)
    if len(rows):
        picked, columns = linear_sum_assignment(-(np.abs(cosine) + own)[rows])
        for j, k in zip(rows[picked].tolist(), columns.tolist(), strict=True):
            serves[j] = k
            strength[j] = float(response[j] @ unit[k] / np.linalg.norm(expected[k]))
            misfit[j] = math.acos(min(1.0, abs(float(cosine[j, k]))))
    return serves, strength, misfit


_STILL, _MOVED = 5e-3, 0.1
"""Largest rotation (rad) of a body at rest, and largest accepted share of rotation in a field change."""


def _moved(test: CoilTest) -> list[Finding]:
    """Return a finding if a rotation of the body contributes noticeably to the measured field changes.

    In the field of a Helmholtz coil, the torque of a coil rotates a body that is not held.
    """
    change = np.linalg.norm(np.stack([test.plus, test.minus]), axis=2) * test.commanded
    if not test.sensed or test.rotation <= max(
        _STILL, _MOVED * float(change.max()) / max(test.ambient, 1e-9)
    ):
        return []
    text = f"the body rotated by {math.degrees(test.rotation):.1f} deg while a coil was driven"
    cure = "hold the body still, and repeat the step: the rotation changes the measured field"
    return [Finding("coils", "moved", text, cure)]


def _shared_fault(test: CoilTest, state: CoilsFound, size_known: bool) -> tuple[list[Finding], float]:
    """Return the faults common to all coils, and the ratio of measured to commanded current."""
    live, drawn, count = state.live, state.drawn, len(state.live)
    flowing = drawn > 0.12
    found = []
    idle_volts, driven_volts = test.volts
    if driven_volts < 0.95 * idle_volts:
        text = f"the supply falls from {idle_volts:.2f} to {driven_volts:.2f} V while a coil is driven"
        cure = "use a stronger supply or shorter, thicker wires; check its plug, and charge the battery"
        return [Finding("coils", "sagging supply", text, cure)], 1.0
    if abs(test.idle) > max(0.1 * float(np.median(test.commanded)), 0.008):
        text = f"the supply delivers {1e3 * test.idle:.0f} mA with all coils at zero"
        cure = "switch the coils' supply off, and look for a bridge leg that is stuck high"
        found.append(Finding("coils", "current while off", text, cure))
    if not live.any() and not flowing.any():
        unknown = not np.isfinite(drawn).any()
        text = f"none of the {count} coils makes a field{'' if unknown else ' or draws current'}"
        cure = "check the coils' supply, the output enable line, and the magnetometer"
        return [*found, Finding("coils", "no field" if unknown else "no supply", text, cure)], 1.0
    if not live.any() and count > 1:
        text = "the coils draw current, but the measured field does not change"
        cure = "the magnetometer is stuck or far from the coils: move or replace it"
        return [*found, Finding("inertial_unit.magnetometer", "no response", text, cure)], 1.0
    if live.sum() > 1 and np.isfinite(drawn).all() and np.abs(drawn).max() < 0.03:
        text = "the coils make their fields, but the measured current stays zero"
        cure = "wire the monitor's shunt into the supply line of the bridges"
        return [*found, Finding("power_monitor", "no current", text, cure)], 1.0
    usable = live & (np.abs(drawn) > 0.03)
    common = float(np.median(drawn[usable])) if usable.sum() > 1 else 1.0
    alike = np.abs(drawn[usable] / common - 1.0) < _NEAR
    if abs(common - 1.0) < _NEAR or 2 * int(alike.sum()) <= int(usable.sum()):
        return found, 1.0
    return [*found, *_wrong_current(test, state, common, size_known)], common


def _wrong_current(test: CoilTest, state: CoilsFound, common: float, size_known: bool) -> list[Finding]:
    """Return the finding about a supply current that is `common` times the command for all coils."""
    fields = float(np.median(np.abs(state.strength[state.live])))
    bound = "at least " if test.clipped else ""
    text = f"the measured current is {bound}{common:.3g} times the commanded one"
    if size_known and abs(common / fields - 1.0) < _NEAR:
        cure = f"correct the supply; or multiply `supply_voltage` by {common:.3g}"
        return [Finding("coils", "wrong supply voltage", f"{text}, and so are the fields", cure)]
    if common < 0.0:
        cure = "swap the two wires at its shunt"
        return [Finding("power_monitor", "reversed", text, cure)]
    cure = f"set `shunt` to the fitted value, {bound}{common:.3g} times the configured value"
    if size_known or not 0.3 < common < 3.0:
        return [Finding("power_monitor", "wrong shunt", text, cure)]
    cure = (
        "check the shunt, `supply_voltage` and the resistances; the configuration states no field strengths"
    )
    return [Finding("power_monitor", "wrong current", text, cure)]


def _coil_findings(
    state: CoilsFound, j: int, names: Sequence[str], legs: FloatArray, absent: float
) -> list[Finding]:
    """Return the faults of the command to coil `j`, given its field (2,), T/A, for both current directions.

    The argument `absent` is the fraction of the samples in which the coil's magnetic field is missing.
    """
    part, name, k = f"coils.windings[{j}]", names[j], state.serves[j]
    if not state.live[j]:
        return [_without_field(part, name, float(state.drawn[j]))]
    if j in state.joined:
        return [_several_coils(part, name, names[state.joined[j]], float(state.drawn[j]))]
    if absent > 0.04:
        text = f"coil {name}: its field is missing in {100.0 * absent:.0f} % of the samples"
        cure = "check the coil's plug and solder joints for loose contact"
        return [Finding(part, "intermittent", text, cure)]
    if state.misfit[j] >= state.askew:
        shown = ", ".join(f"{value:.2f}" for value in state.response[j] / np.linalg.norm(state.response[j]))
        degrees = math.degrees(state.misfit[j])
        text = f"coil {name}: its field is {degrees:.0f} deg off the expected direction, along ({shown})"
        cure = "mount the coil as configured, or set its `axis`; remove iron and magnets"
        return [Finding(part, "wrong direction", text, cure)]
    found = []
    if k != j:
        reversed_too = ", reversed" if state.strength[j] < 0 else ""
        text = f"the command of coil {name} drives coil {names[k]}{reversed_too}"
        found.append(Finding(part, "exchanged", text, "use the fragment's `channels`, or swap the plugs"))
    elif state.strength[j] < 0:
        text = f"coil {name}: its field is opposite"
        found.append(Finding(part, "reversed", text, "set `sign: -1`, or swap the coil's two wires"))
    if legs.min() < 0.25 * legs.max():
        way, leg = ("positive", "A") if legs[0] < legs[1] else ("negative", "B")
        text, cure = f"coil {name}: a {way} current makes no field", f"check input {leg} of its bridge"
        return [*found, Finding(part, "half bridge", text, f"{cure}, and the PWM channel")]
    return found + _wrong_size(part, name, abs(float(state.strength[j])), float(state.drawn[j]))


def _several_coils(part: str, name: str, other: str, drawn: float) -> Finding:
    """Return the finding about a command that drives two coils with `drawn` times the commanded current."""
    way = "in parallel, " if drawn > 1.5 else "in series, " if drawn < 0.7 else ""
    shown = "" if math.isnan(drawn) else f" with {drawn:.2f} times the commanded current"
    text = f"the command of coil {name} drives coils {name} and {other}{shown}"
    cure = f"separate the coils, which are connected {way}and connect coil {other} to its own bridge"
    return Finding(part, "several coils", text, cure)


def _without_field(part: str, name: str, drawn: float) -> Finding:
    """Return the finding about a coil that draws `drawn` times the commanded current but has no field."""
    if math.isnan(drawn):
        text = f"coil {name}: its field does not change"
        return Finding(part, "no field", text, "check wires and channels")
    if drawn < 0.12:
        cure = "check the coil's wires and plug, and the bridge's `channels`"
        return Finding(part, "open", f"coil {name}: no field and no current", cure)
    text = f"coil {name}: no field, but {drawn:.2f} times the commanded current"
    if drawn > 1.2:
        return Finding(part, "short", text, "separate the coil's wires: the bridge drives a short circuit")
    return Finding(part, "current without field", text, "check the plug: the current bypasses the coil")


def _wrong_size(part: str, name: str, size: float, drawn: float) -> list[Finding]:
    """Return the finding about a coil whose field or current differs in magnitude from the expected value."""
    allowed, known = _NEAR + 0.05, not math.isnan(drawn)
    right_current = not known or abs(drawn - 1.0) <= allowed
    if abs(size - 1.0) <= allowed and right_current:
        return []
    text = f"coil {name}: field {size:.2f} times the expected one"
    text += f", current {drawn:.2f} times the commanded one" if known else ""
    if right_current:
        cure = f"check turns and position of the coil; multiply its dipole moment per ampere by {size:.2f}"
        return [Finding(part, "wrong strength", text, cure)]
    if drawn > 0.0 and abs(drawn / size - 1.0) <= _NEAR:
        cure = f"multiply `resistance` by {1.0 / drawn:.2f}"
        return [Finding(part, "wrong resistance", text, cure, 1.0 / drawn)]
    if drawn > 1.3:
        return [Finding(part, "short", text, "separate the shorted turns or wires")]
    return [Finding(part, "unlike", f"{text}, {UNRECOGNISED}", "check coil, plug and bridge")]
