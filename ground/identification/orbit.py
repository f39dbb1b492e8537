"""Description of a satellite (inertia, coils, sensors) that its attitude filter has learned in flight.

Each packet `description` in the flight log contains the estimated inertia, coils, sensors and residual dipole
with their standard deviations. The last packet of a run is compared with the configuration of the run, and
the learned values are written as sections of a configuration.

From the motion, the elements of the inertia and the coils' dipole can be determined only relative to the
trace of the inertia. The learned inertia is therefore scaled to the configured trace, and the coils' dipole
is scaled by the same factor.
"""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flight.bodies.orbit.body import filter_settings
from flight.schema.bodies import OrbitConfig
from flight.schema.devices import Camera, camera_model
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.inertia import inertia_problem
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.errors import InputError
from knightcube.gnc.estimation import free_filter as states
from knightcube.gnc.estimation.rigid_body import BodyErrors, inertia_covariance, per_trace, tensor
from knightcube.vision.camera.lens import Lens
from knightcube.vision.lens_knowledge import axes_turn

Object = dict[str, Any]
LEARNED = 0.5
"""Maximum ratio of estimated to configured standard deviation (rms) at which a quantity counts as learned."""
_UNIFORM = math.sqrt(3.0)  # largest error of a uniform distribution with a standard deviation of one
_FRACTIONS = np.geomspace(1.0, 1e-3, 13).tolist()
"""Factors, in decreasing order, by which the search multiplies the configured inertia accuracies."""
_ELEMENTS = ("xx", "yy", "zz", "yz", "zx", "xy")
_AXES = ("x", "y", "z")
_MATRIX = tuple(a + b for a in _AXES for b in _AXES)


@dataclass(frozen=True, slots=True, eq=False)
class LearnedQuantity:
    """A quantity with n elements in the description of a satellite.

    Attributes:
        name: name of the quantity.
        labels: names of the elements.
        unit: unit of all values.
        described: values (n,) in the configuration of the run.
        value: estimated values (n,) at the end of the run.
        claim: standard deviations (n,) of `value` according to the attitude filter.
        prior: standard deviations (n,) of `described`, from the configured accuracies.
    """

    name: str
    labels: tuple[str, ...]
    unit: str
    described: FloatArray
    value: FloatArray
    claim: FloatArray
    prior: FloatArray

    @property
    def learned(self) -> bool:
        """Whether the flight has reduced the uncertainty of the quantity to less than half."""
        return float(np.sum(self.claim**2)) < LEARNED**2 * float(np.sum(self.prior**2))

    @property
    def change(self) -> FloatArray:
        """Changes (n,) of the learned values, divided by `claim`; NaN if `claim` is zero."""
        known = np.where(self.claim > 0.0, self.claim, math.nan)
        return np.asarray((self.value - self.described) / known)


@dataclass(frozen=True, slots=True, eq=False)
class LearnedDescription:
    """Learned quantities by name, and the mission time (s) of the packet that contains them.

    The learned lens `lens` is None if the star camera has not learned its lens.
    """

    config: OrbitConfig
    time: float
    quantities: dict[str, LearnedQuantity]
    lens: Object | None = None


def learned_description(run: Run, config: OrbitConfig) -> LearnedDescription:
    """Return the description that the satellite had learned at the end of a run.

    Raises InputError for a run without an estimate, and for a run in which nothing was learned.
    """
    packets = run["description"]
    if not len(packets):
        raise InputError(str(run.folder), "holds no description packet: the attitude was never estimated")
    last = packets[-1]
    inertia = config.craft.inertia_matrix()
    trace = float(np.trace(inertia))
    settings = filter_settings(config)
    prior = settings.error_state(inertia).prior
    sigma = np.sqrt(prior.diagonal())

    def of(name: str) -> FloatArray:
        return np.asarray(last[name], dtype=float)

    scale = trace / float(of("inertia")[:3].sum())
    body, eye = slice(states.INERTIA.start, states.COILS.stop), np.eye(3).ravel()
    elements = inertia[(0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)]
    rows = per_trace(elements / trace, eye)
    ratios = np.sqrt(np.maximum((rows @ prior[body, body] @ rows.T).diagonal(), 0.0))
    none = np.zeros(3)
    found = [
        LearnedQuantity(
            "inertia",
            _ELEMENTS,
            "kg m^2",
            elements,
            scale * of("inertia"),
            trace * of("inertia_ratio_sigma"),
            trace * ratios[:6],
        ),
        LearnedQuantity("coils", _MATRIX, "", eye, scale * of("coils"), of("coils_ratio_sigma"), ratios[6:]),
    ]
    found += [
        LearnedQuantity(name, labels, unit, described, of(name), of(f"{name}_sigma"), sigma[at])
        for name, labels, unit, described, at in (
            ("gyro", _MATRIX, "", eye, states.GYRO_MATRIX),
            ("field", _MATRIX, "", eye, states.FIELD_MATRIX),
            ("field_bias", _AXES, "T", none, states.MAGNET),
            ("camera", _AXES, "rad", none, states.CAMERA),
            ("gyro_bias", _AXES, "rad/s", none, states.GYRO),
            ("dipole", _AXES, "A m^2", np.array(config.craft.residual_dipole), states.DIPOLE),
            ("sunlit_dipole", _AXES, "A m^2", none, states.SUNLIT),
        )
        if name != "camera" or config.camera is not None
    ]
    if not any(one.learned for one in found):
        problem = "every uncertainty is above half of its configured value: fly longer"
        raise InputError(str(run.folder), problem)
    time = float(last["time_ns"]) * 1e-9
    return LearnedDescription(config, time, {one.name: one for one in found}, learned_lens(run))


def learned_lens(run: Run) -> Object | None:
    """Return the lens that the star camera had learned at the end of a run, or None if it learned none."""
    packets = run["lens"]
    if not len(packets):
        return None
    last = packets[-1]
    sigma = last["sigma"].astype(float).tolist()
    return {
        "frames": int(last["frames"]),
        "contradictions": int(last["contradictions"]),
        "focal_length_px": [float(last["focal_length"]), sigma[0]],
        "centre_px": last["centre"].astype(float).tolist(),
        "centre_sigma_px": sigma[1:3],
        "distortion": last["distortion"].astype(float).tolist(),
        "distortion_sigma": sigma[3:5],
        "corner_sigma": float(last["corner_sigma"]),
        "line_time_s": [float(last["line_time"]), sigma[5]],
        "psf_sigma_px": [float(last["psf_sigma"]), sigma[6]],
    }


def fragment(found: LearnedDescription, folder: Path, extends: str) -> str:
    """Return the learned values as a configuration that extends the file `extends`.

    The text names the folder of the run, `folder`, and contains the accuracies of the learned values.
    Quantities that were not learned are omitted, and so are the gyro bias and the dipole in sunlight.
    Raises InputError if the learned inertia is physically impossible.
    """
    sections = [_craft(found), _coils(found), _inertial_unit(found), _camera(found)]
    lines = [
        f"# Made by `knightcube identify` from {str(folder)!a} at {found.time:.0f} s; +- is 1 sigma.",
        f"extends: {json.dumps(extends)}",
    ]
    return "\n".join([*lines, *itertools.chain.from_iterable(sections)]) + "\n"


def _craft(found: LearnedDescription) -> list[str]:
    inertia, coils, dipole = (found.quantities[name] for name in ("inertia", "coils", "dipole"))
    accuracy = found.config.craft.accuracy
    values, accuracies = [], []
    if inertia.learned:
        if problem := inertia_problem(tensor(inertia.value)):
            raise InputError("the learned inertia", problem)
        values = [f"  inertia:   # kg m^2 +- {inertia.claim.max():.2g}, scaled to the configured trace"]
        values += _rows(tensor(inertia.value), 4)
        moments, axes_deg = _inertia_accuracy(found)
        accuracies = [f"moments: {_above(moments)}", f"axes_deg: {_above(axes_deg)}"]
    if dipole.learned:
        values += [f"  residual_dipole: {_row(dipole.value)}   # A m^2 +- {dipole.claim.max():.2g}"]
        accuracies += [f"residual_dipole: {_above(_UNIFORM * float(dipole.claim.max()))}"]
    if coils.learned:
        gain, axes = _largest(coils)
        accuracies += [
            f"coil_gain: {_above(min(gain, accuracy.coil_gain))}",
            f"coil_axes_deg: {_above(min(math.degrees(axes), accuracy.coil_axes_deg))}",
        ]
    if accuracies:
        values += [f"  accuracy: {{{', '.join(accuracies)}}}"]
    return ["craft:", *values] if values else []


def _coils(found: LearnedDescription) -> list[str]:
    """Return the lines of the section `coils`, which lists all coils."""
    learned, coils = found.quantities["coils"], found.config.coils
    if not learned.learned:
        return []
    lines = [
        "coils:",
        f"  windings:   # relative +- {learned.claim.max():.2g}, for the configured trace of the inertia",
    ]
    dipoles = learned.value.reshape(3, 3) @ coils.map().dipoles
    for coil, channels, dipole in zip(coils.windings, coils.channels, dipoles.T, strict=True):
        strength = float(np.linalg.norm(dipole))
        entries = [
            f"axis: {_row(dipole / strength)}",
            f"dipole_per_ampere: {strength:.6g}",
            f"resistance: {coil.resistance!r}",
            f"channels: {list(channels)}",
        ]
        entries += [f"current_limit: {coil.current_limit!r}"] if coil.current_limit is not None else []
        entries += ["sign: -1"] if coil.sign == -1 else []
        lines.append(f"    - {{{', '.join(entries)}}}")
    return lines


def _largest(matrix: LearnedQuantity) -> tuple[float, float]:
    """Return the largest errors of the diagonal and of the off-diagonal elements of a learned matrix."""
    diagonal = np.eye(3, dtype=bool).ravel()
    claims = (matrix.claim[diagonal].max(), matrix.claim[~diagonal].max())
    return _UNIFORM * float(claims[0]), _UNIFORM * float(claims[1])


def _inertia_accuracy(found: LearnedDescription) -> tuple[float, float]:
    """Return the smallest `moments` and `axes_deg` that cover the uncertainty of the learned inertia."""
    one, accuracy = found.quantities["inertia"], found.config.craft.accuracy
    inertia = tensor(one.value)
    trace = float(np.trace(inertia))
    rows = per_trace(one.value / trace, np.zeros(9))[:6, :6]
    best, least = (accuracy.moments, accuracy.axes_deg), math.inf
    for moments, axes_deg in itertools.product(_FRACTIONS, _FRACTIONS):
        tried = accuracy.moments * moments, accuracy.axes_deg * axes_deg
        covariance = inertia_covariance(inertia, BodyErrors(moments=tried[0], axes=math.radians(tried[1])))
        variances = (rows @ covariance @ rows.T).diagonal()
        size = float(variances.sum())
        if size < least and bool((trace**2 * variances >= one.claim**2).all()):
            best, least = tried, size
    return best


def _inertial_unit(found: LearnedDescription) -> list[str]:
    gyro, field, bias = (found.quantities[name] for name in ("gyro", "field", "field_bias"))
    unit = found.config.inertial_unit
    known, accuracy = unit.calibration, unit.accuracy
    values, accuracies = [], []
    if gyro.learned:
        # The learned matrix refers to readings that were corrected by the configured matrix.
        values += [f"    gyro_matrix:   # +- {gyro.claim.max():.2g}"]
        values += _rows(np.array(known.gyro_matrix) @ gyro.value.reshape(3, 3), 6)
        scale, alignment = _largest(gyro)
        accuracies += [
            f"gyro_scale: {_above(min(scale, accuracy.gyro_scale))}",
            f"gyro_alignment: {_above(min(alignment, accuracy.gyro_alignment))}",
        ]
    matrix = np.array(known.field_matrix)
    if field.learned:
        values += [f"    field_matrix:   # +- {field.claim.max():.2g}"]
        values += _rows(matrix @ field.value.reshape(3, 3), 6)
        accuracies += [f"field_matrix: {_above(min(_UNIFORM * field.claim.max(), accuracy.field_matrix))}"]
    if bias.learned:
        numbers = np.array(known.field_bias) + matrix @ bias.value
        values += [f"    field_bias: {_row(numbers)}   # T +- {bias.claim.max():.2g}"]
        accuracies += [f"field_bias: {_above(min(_UNIFORM * bias.claim.max(), accuracy.field_bias))}"]
    if not values:
        return []
    return ["inertial_unit:", "  calibration:", *values, f"  accuracy: {{{', '.join(accuracies)}}}"]


def _camera(found: LearnedDescription) -> list[str]:
    one, camera = found.quantities.get("camera"), found.config.camera
    if one is None or camera is None:
        return []
    lines: list[str] = []
    accuracies, mounting = [], np.array(camera.mounting)
    if one.learned:
        mounting = multiply(mounting, from_rotation_vector(one.value))
        largest = min(math.degrees(_UNIFORM * one.claim.max()), camera.accuracy.mounting_deg)
        accuracies = [f"mounting_deg: {_above(largest)}"]
    if found.lens is not None:
        # The mounting refers to the optical axis, which differs between the learned and the configured lens.
        focal, (k1, k2) = found.lens["focal_length_px"][0], found.lens["distortion"]
        learned = Lens(camera.columns, camera.rows, focal, tuple(found.lens["centre_px"]), k1, k2)
        mounting = multiply(axes_turn(camera_model(camera), learned), mounting)
        lines, of_accuracy = _lens(found.lens, camera)
        accuracies += of_accuracy
    if one.learned or found.lens is not None:
        lines = [f"  mounting: {_row(mounting / np.linalg.norm(mounting), 10)}", *lines]
    return ["camera:", *lines, f"  accuracy: {{{', '.join(accuracies)}}}"] if lines else []


def _lens(lens: Object, camera: Camera) -> tuple[list[str], list[str]]:
    """Return the lines of the learned lens in the section `camera`, and the entries of `accuracy`."""
    (focal, focal_sigma), (line_time, line_time_sigma) = lens["focal_length_px"], lens["line_time_s"]
    k1, k2 = lens["distortion"]
    shape = "" if camera.lens is None else f", aspect: {camera.lens.aspect!r}, shear: {camera.lens.shear!r}"
    shape += "" if camera.lens is None else f", p1: {camera.lens.p1!r}, p2: {camera.lens.p2!r}"
    lines = [
        f"  field_of_view_deg: {2.0 * math.degrees(math.atan(0.5 * camera.columns / focal)):.6f}",
        f"  lens: {{focal_length: {focal:.4f}, centre: {_row(np.array(lens['centre_px']))},"
        f" k1: {k1:.8f}, k2: {k2:.8f}{shape}}}   # learned from {lens['frames']} frames",
        f"  line_time: {max(line_time, 0.0):.4g}",
        f"  psf_sigma: {lens['psf_sigma_px'][0]:.4g}",
    ]
    centre = math.hypot(*lens["centre_sigma_px"]) / math.sqrt(2.0)
    accuracies = [
        f"focal_length: {_above(focal_sigma / focal)}",
        f"centre: {_above(centre)}",
        f"distortion: {_above(lens['corner_sigma'])}",
        f"line_time: {_above(line_time_sigma)}",
    ]
    return lines, accuracies


def _row(numbers: FloatArray, digits: int = 7) -> str:
    return f"[{', '.join(f'{number:.{digits}g}' for number in numbers)}]"


def _rows(matrix: FloatArray, indent: int) -> list[str]:
    return [f"{' ' * indent}- {_row(row)}" for row in matrix]


def _above(number: float) -> str:
    """Return a positive number, rounded up to three digits."""
    digits = 2 - math.floor(math.log10(number)) if number > 0.0 else 0
    return f"{math.ceil(number * 10.0**digits - 1e-9) / 10.0**digits:.6g}"
