"""A free body in low Earth orbit, rotated by its coils and by the disturbance torques.

The flight software assumes nominal properties of the craft. The true properties of the craft differ from the
nominal properties by random errors drawn from a seed, as a built satellite differs from its design. The
torques on the body are those of coils, residual dipole, gravity gradient, drag and solar radiation. The drag
on a face that is exposed to the flow is given by Wertz 1978, eq. 17.61, with a drag coefficient of 2.2. The
solar radiation force on a sunlit face is given by Montenbruck & Gill 2000, eq. 3.73. The faces of a box do
not shade each other.

Euler's equations are integrated in principal axes by the classical Runge-Kutta method. Every stage evaluates
the torques that depend on the attitude, namely the torques of the dipole in the field and of the gravity
gradient (Wertz 1978, eq. 17.28). The error of a step in which the body rotates by 0.01 rad is 1e-13 rad. The
code uses Python floats, because numpy takes ten times as long for three components.

The rotation is integrated when the state is read and when the currents change. Reading the state at other
times would change the attitude by less than a microradian. Drag torque, solar radiation torque and residual
dipole are kept constant in body axes for 0.1 s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import mul
from typing import NamedTuple

import msgspec
import numpy as np

from flight.schema.bodies import OrbitConfig
from flight.schema.devices import Coils, Winding
from flight.schema.document import ConfigError, inertia_matrix
from flight.schema.sections import Config
from hal.interfaces.wires import SECOND_NS
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.sun import DAY
from knightcube.astro.inertia import inertia_problem, principal_axes
from knightcube.astro.quaternion import Quaternion, compose, cross, exponential
from knightcube.compiled import compiled_floats, loop_helper
from sim_hal.clock import NEVER
from sim_hal.description_errors import NO_ERRORS, DescriptionErrors, description_errors
from sim_hal.settings import CraftSection, Disturbances, FreeBodySection, TipOff, utc_seconds
from sim_hal.worlds.orbit import Environment, air_flow, elements, julian_date
from sim_hal.worlds.world import BodyMotion, Floats, OrbitEnvironment, OrbitTruth, WorldInputs, WorldTruth

State = tuple[float, float, float, float, float, float, float]
"""Attitude quaternion of the principal axes (scalar last), followed by the rate about these axes (rad/s)."""

Matrix = tuple[float, float, float, float, float, float, float, float, float]

TURN_PER_STEP = 0.01
"""Largest rotation (rad) of the body in one integration step."""


class Loads(NamedTuple):
    """Dipole, gravity-gradient vector and torque that act on the body during an integration step.

    Attributes:
        dipole: magnetic dipole (3,) of the body, A m^2, principal axes.
        pull: gravity-gradient vector (3,): position times sqrt(3 mu / r^5), rad/s, inertial axes.
        torque: sum (3,) of drag and solar radiation torque, N m, principal axes.
    """

    dipole: Floats
    pull: Floats
    torque: Floats


class Rotation:
    """Integrator of the rotation of a body with principal moments of inertia `inertia` (3,), kg m^2."""

    def __init__(self, inertia: Floats) -> None:
        a, b, c = inertia
        self.inertia = inertia
        self._of_rates = ((b - c) / a, (c - a) / b, (a - b) / c)
        self._of_torques = (1.0 / a, 1.0 / b, 1.0 / c)

    def step(self, state: State, dt: float, begin: Floats, end: Floats, loads: Loads) -> State:
        """Return the rotational state after `dt` s.

        The magnetic field changes from `begin` to `end` (3,), T, inertial axes.
        """
        return _stepped(state, dt, begin, end, *loads, self._of_rates, self._of_torques)


@compiled_floats
def _stepped(
    state: State,
    dt: float,
    begin: Floats,
    end: Floats,
    dipole: Floats,
    pull: Floats,
    torque: Floats,
    of_rates: Floats,
    of_torques: Floats,
) -> State:
    """Return the rotational state after a step, as `Rotation.step` describes.

    The factors `of_rates` give the angular accelerations of products of rates, and the factors `of_torques`
    (1/(kg m^2)) those of torques.
    """
    middle = (0.5 * (begin[0] + end[0]), 0.5 * (begin[1] + end[1]), 0.5 * (begin[2] + end[2]))
    half = 0.5 * dt
    first = _slope(state, begin, dipole, pull, torque, of_rates, of_torques)
    second = _slope(_moved(state, first, half), middle, dipole, pull, torque, of_rates, of_torques)
    third = _slope(_moved(state, second, half), middle, dipole, pull, torque, of_rates, of_torques)
    fourth = _slope(_moved(state, third, dt), end, dipole, pull, torque, of_rates, of_torques)
    a1, a2, a3, a4, a5, a6, a7 = fourth
    b1, b2, b3, b4, b5, b6, b7 = first
    c1, c2, c3, c4, c5, c6, c7 = second
    d1, d2, d3, d4, d5, d6, d7 = third
    q1, q2, q3, q4, w1, w2, w3 = state
    sixth = dt / 6.0
    q1 += sixth * (a1 + 2.0 * (c1 + d1) + b1)
    q2 += sixth * (a2 + 2.0 * (c2 + d2) + b2)
    q3 += sixth * (a3 + 2.0 * (c3 + d3) + b3)
    q4 += sixth * (a4 + 2.0 * (c4 + d4) + b4)
    w1 += sixth * (a5 + 2.0 * (c5 + d5) + b5)
    w2 += sixth * (a6 + 2.0 * (c6 + d6) + b6)
    w3 += sixth * (a7 + 2.0 * (c7 + d7) + b7)
    unit = 1.0 / math.sqrt(q1 * q1 + q2 * q2 + q3 * q3 + q4 * q4)
    return q1 * unit, q2 * unit, q3 * unit, q4 * unit, w1, w2, w3


@loop_helper
def _slope(
    state: State,
    field: Floats,
    dipole: Floats,
    pull: Floats,
    torque: Floats,
    of_rates: Floats,
    of_torques: Floats,
) -> State:
    """Return the time derivative of the state in a magnetic field (3,), T, inertial axes."""
    q1, q2, q3, q4, w1, w2, w3 = state
    (mx, my, mz), (tx, ty, tz) = dipole, torque
    a11, a12, a13, a21, a22, a23, a31, a32, a33 = matrix(q1, q2, q3, q4)
    x, y, z = field
    bx, by, bz = a11 * x + a12 * y + a13 * z, a21 * x + a22 * y + a23 * z, a31 * x + a32 * y + a33 * z
    x, y, z = pull
    gx, gy, gz = a11 * x + a12 * y + a13 * z, a21 * x + a22 * y + a23 * z, a31 * x + a32 * y + a33 * z
    i1, i2, i3 = of_torques
    k1, k2, k3 = of_rates
    # Gravity-gradient and gyroscopic torques have the same factors: differences of principal moments.
    return (
        0.5 * (w3 * q2 - w2 * q3 + w1 * q4),
        0.5 * (w1 * q3 - w3 * q1 + w2 * q4),
        0.5 * (w2 * q1 - w1 * q2 + w3 * q4),
        -0.5 * (w1 * q1 + w2 * q2 + w3 * q3),
        k1 * (w2 * w3 - gy * gz) + i1 * (tx + my * bz - mz * by),
        k2 * (w3 * w1 - gz * gx) + i2 * (ty + mz * bx - mx * bz),
        k3 * (w1 * w2 - gx * gy) + i3 * (tz + mx * by - my * bx),
    )


@loop_helper
def _moved(state: State, slope: State, dt: float) -> State:
    """Return `state` + `dt` * `slope`."""
    q1, q2, q3, q4, w1, w2, w3 = state
    d1, d2, d3, d4, d5, d6, d7 = slope
    return (
        q1 + dt * d1, q2 + dt * d2, q3 + dt * d3, q4 + dt * d4, w1 + dt * d5, w2 + dt * d6, w3 + dt * d7
    )  # fmt: skip


@loop_helper
def matrix(q1: float, q2: float, q3: float, q4: float) -> Matrix:
    """Return the attitude matrix of a quaternion as nine floats, row by row."""
    r11, r22, r33, r44 = q1 * q1, q2 * q2, q3 * q3, q4 * q4
    r12, r13, r14, r23, r24, r34 = q1 * q2, q1 * q3, q1 * q4, q2 * q3, q2 * q4, q3 * q4
    return (
        r11 - r22 - r33 + r44, 2.0 * (r12 + r34), 2.0 * (r13 - r24),
        2.0 * (r12 - r34), r22 - r11 - r33 + r44, 2.0 * (r23 + r14),
        2.0 * (r13 + r24), 2.0 * (r23 - r14), r33 - r11 - r22 + r44,
    )  # fmt: skip


def turned(turn: Matrix, vector: Floats) -> Floats:
    """Return the product of a 3 x 3 matrix and a vector."""
    a, b, c, d, e, f, g, h, i = turn
    x, y, z = vector
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def steps_within(span: float, rate: float, longest: float) -> int:
    """Return the number of steps for `span` s at the rate `rate` rad/s.

    A step lasts at most `longest` s and rotates the body by at most `TURN_PER_STEP`.
    """
    return max(1, math.ceil(span / longest - 1e-9), math.ceil(span * rate / TURN_PER_STEP))


PRESSURE_ARM = 0.02
"""Largest distance (m) from the centre of mass to the centre of pressure that the CubeSat standard allows."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CraftModel:
    """Configured properties of a craft, without the errors of the true craft.

    Attributes:
        inertia: inertia tensor (3, 3) in body axes, kg m^2.
        size: edges (3,) of the box along the body axes, m.
        dipoles: dipole moment of each coil per ampere (3, n), m^2, body axes, one column per coil.
        centre_of_mass: vector (3,) from the centre of the box to the centre of mass, m, body axes.
        offset: distance between the true and the configured centre of mass, m.
        residual_dipole: residual dipole (3,) in shadow, A m^2, body axes.
    """

    inertia: FloatArray
    size: tuple[float, float, float]
    dipoles: FloatArray
    centre_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset: float = PRESSURE_ARM
    residual_dipole: tuple[float, float, float] = (0.0, 0.0, 0.0)


CRAFTS = {
    # The inertia is from Sease 2013, Table 5.1 (exponent corrected); a coil has 80 turns of 0.0081 m^2.
    "knightcube": CraftModel(
        inertia=np.diag([1.10e-3, 1.05e-3, 0.99e-3]), size=(0.1, 0.1, 0.1), dipoles=0.648 * np.eye(3)
    ),
    # The 3U CubeSat has an assumed mass of 4 kg and coils of 57.8 ohm, 0.2 A m^2 at 58.8 mA, 5 W/(A m^2)^2.
    "cubesat_3u": CraftModel(
        inertia=np.diag([0.0066, 0.0333, 0.0333]), size=(0.3, 0.1, 0.1), dipoles=3.4 * np.eye(3)
    ),
}

CONSTANT_DIPOLE, SUNLIT_DIPOLE, WALKING_DIPOLE = 1e-3, 3e-4, 5e-5
"""Largest constant part, largest sunlit part, and random walk's sigma of the residual dipole (A m^2)."""
_REFLECTED = (0.1, 0.6)
"""Lower and upper bound of the fraction of sunlight that a face reflects specularly."""


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A flat face of the craft.

    `normal` is the outward normal and `arm` (m) the vector from the centre of mass to the centre of the face,
    both in body axes. `area` is in m^2. `mirrored` is the fraction of sunlight that is reflected specularly;
    the remaining light is absorbed.
    """

    normal: tuple[float, float, float]
    arm: tuple[float, float, float]
    area: float
    mirrored: float


@dataclass(frozen=True, slots=True, eq=False)
class TrueCraft:
    """True properties of a craft.

    Attributes:
        inertia: principal moments of inertia (3,), kg m^2.
        to_principal: quaternion (4,) from body axes to principal axes.
        faces: faces of the craft's box.
        coil_dipole: matrix (3, n), m^2, that maps coil currents to the dipole in body axes.
        coil_frames: rotation matrices (n, 3, 3) from the function `coil_frames`; the errors of the coils are
            drawn in the rotated axes.
        constant_dipole: constant part (3,) of the residual dipole, A m^2, body axes.
        sunlit_dipole: part (3,) of the residual dipole that sunlight at one astronomical unit causes, A m^2,
            body axes.
        walking_dipole: standard deviation of the residual dipole's random walk on each axis, A m^2.
    """

    inertia: tuple[float, float, float]
    to_principal: FloatArray
    faces: tuple[Face, ...]
    coil_dipole: FloatArray
    coil_frames: FloatArray
    constant_dipole: FloatArray
    sunlit_dipole: FloatArray
    walking_dipole: float


def coil_frames(dipoles: FloatArray) -> FloatArray:
    """Return the rotation matrix (n, 3, 3) of each coil, from body axis x, y or z (in turn) to its axis."""
    frames = []
    for index, dipole in enumerate(dipoles.T):
        start, end = np.eye(3)[index % 3], dipole / np.linalg.norm(dipole)
        if float(start @ end) == 1.0:
            frames.append(np.eye(3))
            continue
        # Rotations by 180 deg about `start` and then about the bisector `middle` rotate `start` to `end`.
        middle = start + end
        across = np.eye(3)[(index + 1) % 3]
        if float(middle @ middle) < 1e-12:
            frames.append(2.0 * np.outer(across, across) - np.eye(3))
            continue
        halves = 2.0 * np.outer(middle, middle) / float(middle @ middle) - np.eye(3)
        frames.append(halves @ (2.0 * np.outer(start, start) - np.eye(3)))
    return np.array(frames)


def build(section: CraftModel, disturbances: Disturbances, generator: np.random.Generator) -> TrueCraft:
    """Return the craft with random errors from one seed.

    The number of random draws does not depend on the disturbance multiples, so the random directions of a
    seed are the same for every multiple.
    """
    moments, axes = principal_axes(section.inertia)
    x, y, z = moments.tolist()
    widest = math.radians(disturbances.principal_turn_deg)
    turn = generator.uniform(widest / 3.0, widest) * _direction(generator)
    arm = section.offset * _direction(generator) - np.array(section.centre_of_mass)
    mirrored = generator.uniform(*_REFLECTED, 6)
    count = section.dipoles.shape[1]
    scale = 1.0 + disturbances.coil_scale * generator.standard_normal(count)
    tilt = math.radians(disturbances.coil_tilt_deg) * generator.standard_normal((3, count))
    tilt[np.arange(count) % 3, np.arange(count)] = 1.0
    # Each column is the tilted axis of a coil times the coil's dipole per ampere.
    columns = np.linalg.norm(section.dipoles, axis=0) * scale * tilt / np.linalg.norm(tilt, axis=0)
    constant, sunlit = _direction(generator), _direction(generator)
    worst = disturbances.residual_dipole
    return TrueCraft(
        inertia=(x, y, z),
        to_principal=quaternion.multiply(quaternion.from_matrix(axes), quaternion.from_rotation_vector(turn)),
        faces=box(section.size, arm, mirrored),
        coil_dipole=np.einsum("kij,jk->ik", coil_frames(section.dipoles), columns),
        coil_frames=coil_frames(section.dipoles),
        constant_dipole=np.array(section.residual_dipole) + worst * CONSTANT_DIPOLE * constant,
        sunlit_dipole=worst * SUNLIT_DIPOLE * sunlit,
        walking_dipole=worst * WALKING_DIPOLE,
    )


def box(size: tuple[float, float, float], arm: FloatArray, mirrored: FloatArray) -> tuple[Face, ...]:
    """Return the six faces of a box of `size` m.

    `arm` (3,), m, is the vector from the centre of mass to the centre of the box.
    """
    faces = []
    for index in range(6):
        axis, sign = index // 2, 1.0 - 2.0 * (index % 2)
        normal = np.zeros(3)
        normal[axis] = sign
        nx, ny, nz = normal.tolist()
        ax, ay, az = (arm + 0.5 * size[axis] * normal).tolist()
        area = size[0] * size[1] * size[2] / size[axis]
        faces.append(Face((nx, ny, nz), (ax, ay, az), area, float(mirrored[index])))
    return tuple(faces)


def _direction(generator: np.random.Generator) -> FloatArray:
    """Return a random direction (3,), uniform over the sphere."""
    vector = generator.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


DRAG_COEFFICIENT = 2.2
SOLAR_PRESSURE = 4.56e-6
"""Solar radiation pressure (N/m^2) on a black face at one astronomical unit."""

ZERO: Floats = (0.0, 0.0, 0.0)


def air_torque(faces: Sequence[Face], flow: Floats, density: float) -> Floats:
    """Return the drag torque (3,), N m, at the velocity `flow` through the air, m/s, both in body axes."""
    vx, vy, vz = flow
    half = 0.5 * DRAG_COEFFICIENT * density
    # All drag forces are parallel to the flow, so the weighted arms are summed before a single cross product.
    x = y = z = 0.0
    for face in faces:
        nx, ny, nz = face.normal
        against = nx * vx + ny * vy + nz * vz
        if against > 0.0:
            weight = half * face.area * against
            ax, ay, az = face.arm
            x += weight * ax
            y += weight * ay
            z += weight * az
    return z * vy - y * vz, x * vz - z * vx, y * vx - x * vy


def sunlight_torque(faces: Sequence[Face], sun: Floats, light: float) -> Floats:
    """Return the solar radiation torque (3,), N m, body axes.

    `sun` (3,) is the direction to the Sun in body axes. `light` is the solar irradiance as a fraction of the
    irradiance at 1 au.
    """
    if light <= 0.0:
        return ZERO
    sx, sy, sz = sun
    tx = ty = tz = 0.0
    for face in faces:
        nx, ny, nz = face.normal
        cosine = nx * sx + ny * sy + nz * sz
        if cosine > 0.0:
            scale = -SOLAR_PRESSURE * light * face.area * cosine
            along, normal = scale * (1.0 - face.mirrored), 2.0 * scale * face.mirrored * cosine
            fx, fy, fz = along * sx + normal * nx, along * sy + normal * ny, along * sz + normal * nz
            ax, ay, az = face.arm
            tx += ay * fz - az * fy
            ty += az * fx - ax * fz
            tz += ax * fy - ay * fx
    return tx, ty, tz


class LoadModel:
    """Model of the dipoles and torques of one craft.

    The factors `multiples` scale the worst-case disturbances of the craft.
    """

    def __init__(self, craft: TrueCraft, multiples: Disturbances) -> None:
        self._faces = craft.faces
        self._drag, self._sunlight = multiples.drag, multiples.solar_pressure
        self._gradient = math.sqrt(3.0 * multiples.gravity_gradient * GRAVITATIONAL_PARAMETER)
        # The coils are grouped by three; missing coils of the last group have zero dipole.
        missing = -craft.coil_dipole.shape[1] % 3
        self._idle = [0.0] * missing
        coils = np.pad(craft.coil_dipole, ((0, 0), (0, missing)))
        groups = [coils[:, first : first + 3].ravel().tolist() for first in range(0, coils.shape[1], 3)]
        self._coils: list[Matrix] = [(a, b, c, d, e, f, g, h, i) for a, b, c, d, e, f, g, h, i in groups]
        x, y, z = craft.constant_dipole.tolist()
        self._constant: Floats = (x, y, z)
        x, y, z = craft.sunlit_dipole.tolist()
        self._sunlit: Floats = (x, y, z)
        self._walking = craft.walking_dipole

    def coil_dipole(self, currents: tuple[float, ...]) -> Floats:
        """Return the dipole moment (3,), A m^2, of the coils at currents (n,), A."""
        x, y, z, *others = currents
        dipole = turned(self._coils[0], (x, y, z))
        if others:
            a, b, c = dipole
            x, y, z = [*others, *self._idle]
            d, e, f = turned(self._coils[1], (x, y, z))
            dipole = a + d, b + e, c + f
        return dipole

    def residual_dipole(self, around: OrbitEnvironment) -> Floats:
        """Return the residual dipole (3,), A m^2, body axes."""
        light, walking = around.light, self._walking
        (a, b, c), (d, e, f), (x, y, z) = self._constant, self._sunlit, around.walk
        return a + light * d + walking * x, b + light * e + walking * y, c + light * f + walking * z

    def pull(self, position: Floats) -> Floats:
        """Return the gravity-gradient vector `Loads.pull` (3,), rad/s, at a position (3,), m."""
        x, y, z = position
        squared = x * x + y * y + z * z
        scale = self._gradient / (squared * math.sqrt(math.sqrt(squared)))
        return scale * x, scale * y, scale * z

    def pressures(self, around: OrbitEnvironment, to_body: Matrix) -> tuple[Floats, Floats]:
        """Return the drag torque (3,) and the solar radiation torque (3,), N m, body axes.

        The matrix `to_body` rotates ICRS into body axes.
        """
        flow = turned(to_body, air_flow(around))
        drag = air_torque(self._faces, flow, self._drag * around.density)
        light = self._sunlight * around.light
        return drag, sunlight_torque(self._faces, turned(to_body, around.sun), light)


_STREAM = 0xF4EE


def generators(seed: int) -> tuple[np.random.Generator, np.random.Generator, np.random.Generator]:
    """Return the random generators for the craft's errors, for the release, and for the environment."""
    errors, tip_off, weather = (np.random.default_rng([seed, _STREAM, stream]) for stream in range(3))
    return errors, tip_off, weather


LONGEST_STEP = 0.1
"""Longest integration step (s), in which drag, solar radiation and residual dipole are constant."""


@dataclass(frozen=True, slots=True)
class CoilSupply:
    """Resistance (n,), ohm, and supply voltage (V) of the coils."""

    resistance: tuple[float, ...]
    voltage: float


KNIGHTCUBE_SUPPLY = CoilSupply((23.0, 23.0, 23.0), 3.4)
VARIED_FOR = 20.0
"""Interval (s) between the random changes of a coil's dipole per ampere."""


class FreeBody:
    """World with a free body, whose state is advanced in time under the coil currents."""

    def __init__(
        self,
        section: FreeBodySection,
        currents: Callable[[], FloatArray],
        supply: CoilSupply = KNIGHTCUBE_SUPPLY,
        seed: int = 1,
        utc: str = "2026-01-01T00:00:00Z",
        start_ns: int = 0,
        description: DescriptionErrors = NO_ERRORS,
        craft: CraftModel | None = None,
    ) -> None:
        """Create the world with a body that is held still until its release.

        `utc` is the UTC at `start_ns`. The craft is `craft` or, if that is None, the craft that `section`
        describes.
        """
        errors, tip_off, weather = generators(seed)
        multiples = section.disturbances
        self._variation, self._seed, self._interval = multiples.coil_variation, seed, -1
        self._factors: list[float] = []
        self.craft = built_craft(section, errors, description, craft)
        self.utc_start = julian_date(utc)
        self._utc_start_ns = round(utc_seconds(utc)) * SECOND_NS - start_ns
        orbit = elements(section.orbit, self.utc_start)
        self.environment = Environment(orbit, self.utc_start, weather, multiples)
        self._loads = LoadModel(self.craft, multiples)
        self._rotation = Rotation(self.craft.inertia)
        self._currents, self._supply = currents, supply
        x, y, z, w = self.craft.to_principal.tolist()
        self._from_principal: Quaternion = (-x, -y, -z, w)
        self._to_principal, self._to_body = matrix(x, y, z, w), matrix(-x, -y, -z, w)
        attitude, self._tip_off = released(section.release, tip_off)
        a, b, c, d = quaternion.multiply(self.craft.to_principal, attitude).tolist()
        self._state: State = (a, b, c, d, 0.0, 0.0, 0.0)
        self._start_ns, self._release_ns = start_ns, NEVER
        self._held = True
        self._acting: tuple[float, ...] = (0.0,) * len(supply.resistance)
        self._heat = self._power = 0.0  # power (W) that heats the coils, and power drawn from the supply
        self._read: tuple[State, BodyMotion | None] = self._state, None
        self._slot = -1
        self._torque, self._residual = ZERO, ZERO
        # The state `_state` is valid at `_done_ns`; the currents `_acting` flow from `_done_ns` to `time_ns`.
        self._done_ns = self.time_ns = start_ns
        self._pull, self._field = self._gravity_and_field(0.0)
        self.energy = 0.0
        self.supply_energy = 0.0

    def release_at(self, time_ns: int) -> None:
        """Release the body at `time_ns`, which is not before the present time."""
        self._release_ns = time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns` under the present coil currents."""
        if time_ns <= self.time_ns:
            return
        currents = tuple(self._currents().tolist())
        if currents != self._acting:
            self._integrate()
            self._acting = currents
            ohms = self._supply.resistance
            self._heat = sum(ohm * current * current for current, ohm in zip(currents, ohms, strict=True))
            self._power = self._supply.voltage * sum(map(abs, currents))
        self.time_ns = time_ns

    def motion(self, time_ns: int) -> BodyMotion:
        """Advance to `time_ns` and return the motion, whose specific force is zero in free fall."""
        self.advance_to(time_ns)
        self._integrate()
        state, motion = self._read
        if motion is None or motion.time_ns != self.time_ns or state is not self._state:
            motion = BodyMotion(
                time_ns=self.time_ns,
                quaternion=np.array(self._attitude()),
                rate=np.array(turned(self._to_body, self._state[4:])),
                field_body=np.array(turned(self._to_body, turned(matrix(*self._state[:4]), self._field))),
                specific_force_body=np.zeros(3),
            )
            # Truth recorder and inertial unit read the motion at the same times, so the motion is cached.
            self._read = self._state, motion
        return motion

    def surroundings(self) -> OrbitEnvironment:
        """Return the environment of the craft at the present time."""
        return self.environment.at(self._seconds(self.time_ns))

    def utc_ns(self) -> int:
        """Return the present UTC, ns since 1970."""
        return self._utc_start_ns + self.time_ns

    def truth(self) -> WorldTruth:
        """Return the present coil currents and the energies so far."""
        self._integrate()
        return WorldTruth(np.array(self._acting), self.energy, self.supply_energy)

    def orbit_truth(self) -> OrbitTruth:
        """Return the present state of body, orbit and environment."""
        self._integrate()
        around, state, acting = self.surroundings(), self._state, self._acting
        return OrbitTruth(
            current=np.array(acting),
            energy=self.energy,
            supply_energy=self.supply_energy,
            utc=self.utc_start + self._seconds(self.time_ns) / DAY,
            quaternion=np.array(self._attitude()),
            rate=np.array(turned(self._to_body, state[4:])),
            position=np.array(around.position),
            velocity=np.array(around.velocity),
            field=np.array(around.field),
            sun=np.array(around.sun),
            sunlit=around.sunlit,
            residual_dipole=np.array(self._loads.residual_dipole(around)),
            torques=lambda: self._torques(around, state, acting),
        )

    def _torques(
        self, around: OrbitEnvironment, state: State, acting: tuple[float, ...]
    ) -> dict[str, FloatArray]:
        """Return the torque (3,), N m, body axes, by each cause in `CAUSES`."""
        turn, to_body = matrix(*state[:4]), matrix(*compose(self._from_principal, state[:4]))
        field = turned(to_body, around.field)
        drag, sunlight = self._loads.pressures(around, to_body)
        gx, gy, gz = turned(turn, self._loads.pull(around.position))
        a, b, c = self.craft.inertia
        gradient = (c - b) * gy * gz, (a - c) * gz * gx, (b - a) * gx * gy
        return {
            "coils": np.array(cross(self._loads.coil_dipole(self._varied(acting)), field)),
            "residual dipole": np.array(cross(self._loads.residual_dipole(around), field)),
            "gravity gradient": np.array(turned(self._to_body, gradient)),
            "drag": np.array(drag),
            "sunlight": np.array(sunlight),
        }

    def _integrate(self) -> None:
        """Integrate the state up to `time_ns`."""
        if self._held:
            if self.time_ns < self._release_ns:
                self._done_ns = self.time_ns
                self._pull, self._field = self._gravity_and_field(self._seconds(self.time_ns))
                return
            self._held = False
            self._done_ns = max(self._done_ns, self._release_ns)
            self._pull, self._field = self._gravity_and_field(self._seconds(self._done_ns))
            self._state = (*self._state[:4], *turned(self._to_principal, self._tip_off))
        start, end = self._seconds(self._done_ns), self._seconds(self.time_ns)
        if end <= start:
            return
        self.energy += (end - start) * self._heat
        self.supply_energy += (end - start) * self._power
        steps = steps_within(end - start, math.hypot(*self._state[4:]), LONGEST_STEP)
        for step in range(steps):
            self._step(start + (end - start) * step / steps, start + (end - start) * (step + 1) / steps)
        self._done_ns = self.time_ns

    def _step(self, start: float, end: float) -> None:
        slot = int(0.5 * (start + end) / LONGEST_STEP)
        if slot != self._slot:
            self._slot = slot
            self._renew(start, (slot + 0.5) * LONGEST_STEP)
        pull, field = self._gravity_and_field(end)
        a, b, c = self._pull
        d, e, f = pull
        between = 0.5 * (a + d), 0.5 * (b + e), 0.5 * (c + f)
        x, y, z = self._loads.coil_dipole(self._varied(self._acting))
        u, v, w = self._residual
        dipole = turned(self._to_principal, (x + u, y + v, z + w))
        loads = Loads(dipole, between, self._torque)
        self._state = self._rotation.step(self._state, end - start, self._field, field, loads)
        self._pull, self._field = pull, field

    def _renew(self, time: float, middle: float) -> None:
        """Evaluate drag torque, solar radiation torque and residual dipole for the time `middle` (s).

        The attitude is extrapolated to the time `middle`.
        """
        around, ahead = self.environment.at(middle), middle - time
        x, y, z = turned(self._to_body, self._state[4:])
        turn = compose(exponential(ahead * x, ahead * y, ahead * z), self._attitude())
        (a, b, c), (d, e, f) = self._loads.pressures(around, matrix(*turn))
        self._torque = turned(self._to_principal, (a + d, b + e, c + f))
        self._residual = self._loads.residual_dipole(around)
        interval = int(middle / VARIED_FOR)
        if self._variation and interval != self._interval:
            self._interval = interval
            generator = np.random.default_rng([self._seed, _STREAM, 3, interval])
            largest = math.sqrt(3.0) * self._variation
            self._factors = (1.0 + generator.uniform(-largest, largest, len(self._acting))).tolist()

    def _varied(self, currents: tuple[float, ...]) -> tuple[float, ...]:
        """Return the currents (n,), A, that would cause the present dipoles in nominal coils."""
        return tuple(map(mul, currents, self._factors)) if self._factors else currents

    def _gravity_and_field(self, time: float) -> tuple[Floats, Floats]:
        position, field = self.environment.position_and_field(time)
        return self._loads.pull(position), field

    def _attitude(self) -> Quaternion:
        return compose(self._from_principal, self._state[:4])

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - self._start_ns) * 1e-9


FASTEST_RELEASE = 35.0
"""Largest rate (rad/s) at release, about 2000 deg/s; a faster rotation would take hours to integrate."""


def released(tip_off: TipOff, generator: np.random.Generator) -> tuple[FloatArray, Floats]:
    """Return the attitude (4,), ICRS into body, and the rate (3,), rad/s, body axes, at release.

    Raises ConfigError for a quaternion of length zero and for an impossible rate.
    """
    section = "simulation.free_body.release"
    if tip_off.attitude is not None and not any(tip_off.attitude):
        raise ConfigError(f"{section}.attitude", "has length 0: give a quaternion of length 1")
    if tip_off.rate is not None and (speed := math.hypot(*tip_off.rate)) > FASTEST_RELEASE:
        raise ConfigError(f"{section}.rate", f"has {speed:g} rad/s: give at most {FASTEST_RELEASE:g} rad/s")
    attitude = quaternion.normalise(generator.standard_normal(4))
    axis = generator.standard_normal(3)
    if tip_off.attitude is not None:
        attitude = quaternion.normalise(np.array(tip_off.attitude))
    if tip_off.rate is not None:
        return attitude, tip_off.rate
    x, y, z = (tip_off.speed * axis / np.linalg.norm(axis)).tolist()
    return attitude, (x, y, z)


def built_craft(
    section: FreeBodySection,
    errors: np.random.Generator,
    description: DescriptionErrors,
    craft: CraftModel | None = None,
) -> TrueCraft:
    """Return the true craft, which differs from the configured craft by random errors.

    The configured craft is `craft` or, if `craft` is None, the craft of `section`. The argument `description`
    contains the ratios and rotations from the configured to the true properties. The disturbances are drawn
    from the generator `errors`. Raises ConfigError as `craft_model` does.
    """
    built = build(craft or craft_model(section), section.disturbances, errors)
    if description is NO_ERRORS:
        return built
    x, y, z = (np.array(built.inertia) * description.moments).tolist()
    turn = quaternion.from_rotation_vector(description.axes)
    columns = []
    for index, (frame, dipole) in enumerate(zip(built.coil_frames, built.coil_dipole.T, strict=True)):
        first = 3 * (index // 3)
        columns.append(frame @ description.coils[:, first : first + 3] @ frame.T @ dipole)
    return replace(
        built,
        inertia=(x, y, z),
        to_principal=quaternion.multiply(built.to_principal, turn),
        coil_dipole=np.stack(columns, axis=1),
    )


def craft_model(section: FreeBodySection, config: Config | None = None) -> CraftModel:
    """Return the simulated craft; values that `section` omits are taken from the flight configuration.

    Raises ConfigError for an impossible inertia tensor or centre of mass, and for values missing in both
    sections.
    """
    craft = section.craft
    if isinstance(craft, str):
        return CRAFTS[craft]
    if not isinstance(config, OrbitConfig):
        if craft is None:
            return CRAFTS["knightcube"]
        raise ConfigError("simulation.free_body.craft", "needs the configuration of a satellite in orbit")
    craft, described = craft or CraftSection(), config.craft
    inertia = described.inertia_matrix()
    if craft.inertia is not None:
        try:
            inertia = inertia_matrix(craft.inertia)
            problem = inertia_problem(inertia)
        except ValueError:
            problem = "mixes numbers and rows: give three moments, or three rows of three values"
        if problem:
            raise ConfigError("simulation.free_body.craft.inertia", problem)
    size, centre = craft.size or described.size, craft.centre_of_mass or described.centre_of_mass
    if any(abs(offset) >= 0.5 * edge for offset, edge in zip(centre, size, strict=True)):
        problem = f"is {list(centre)}: outside the box of {list(size)} m: give m from the centre of the box"
        raise ConfigError("simulation.free_body.craft.centre_of_mass", problem)
    return CraftModel(
        inertia=inertia,
        size=size,
        dipoles=_true_coils(config.coils, craft.windings).map().dipoles,
        centre_of_mass=centre,
        offset=described.accuracy.centre_of_mass,
        residual_dipole=craft.residual_dipole or described.residual_dipole,
    )


def _true_coils(coils: Coils, windings: Sequence[Winding] | None) -> Coils:
    """Return the coils, with `windings` if given. Raises ConfigError for impossible windings."""
    if windings is None:
        return coils
    key = "simulation.free_body.craft.windings"
    if len(windings) != len(coils.windings):
        raise ConfigError(key, f"must have {len(coils.windings)} entries")
    for index, coil in enumerate(windings):
        if not any(coil.axis):
            problem = f"is {list(coil.axis)}: give the direction of the coil's dipole moment"
            raise ConfigError(f"{key}[{index}].axis", problem)
        try:
            coil.strength()
        except ConfigError as error:
            raise ConfigError(f"{key}[{index}].{error.where}", error.problem) from error
    return msgspec.structs.replace(coils, windings=tuple(windings))


def body_inputs(
    inputs: WorldInputs, world: str
) -> tuple[
    FreeBodySection, Callable[[], FloatArray], CoilSupply, int, str, int, DescriptionErrors, CraftModel
]:
    """Return the arguments of `FreeBody` from a configuration, with the true properties of the coils.

    Raises ConfigError, with the name of the world, if the section `simulation.free_body` is missing.
    """
    section, coils, truth = inputs.section, inputs.config.coils, inputs.section.truth
    if section.free_body is None:
        raise ConfigError("simulation.free_body", f"is missing: {world} needs it")
    supply = CoilSupply(truth.resistance or coils.resistance, truth.supply_voltage or coils.supply_voltage)
    description = description_errors(inputs.config, section)
    craft, times = craft_model(section.free_body, inputs.config), (section.utc, inputs.start_ns)
    return section.free_body, inputs.currents, supply, section.seed, *times, description, craft


def make(inputs: WorldInputs) -> FreeBody:
    """Return the free body of a configuration. Raises ConfigError as `body_inputs` does."""
    return FreeBody(*body_inputs(inputs, "the world free_body"))
