"""Computes inertia, torque constant, stiffness and damping from the fitted ratios to the inertia.

Motion under a known current determines g = n A B / J, k / J and c / J, but not the inertia J itself. For
example, a body with twice the inertia in twice the field on a thread of twice the stiffness has the same
motion. The absolute values follow from prior values of the inertia J, the dipole per ampere n A, and the
field B. The field B is also measured by the magnetometer. The priors are Gaussian in the logarithms of the
values. The measured gain g relates inertia, dipole and field by the constraint
ln n A + ln B - ln J - ln g = 0, which is applied as an error-free measurement, and corrects inertia, dipole
and field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from flight.schema import reader as configuration
from flight.schema.document import to_yaml
from flight.schema.testbed import Plant, Step, TestbedConfig
from ground.identification.fit import NAMES, MotionConstants, MotionNoise, PlantFit
from ground.identification.record import HorizontalField
from knightcube.astro.arrays import FloatArray

INERTIA_ERROR = 0.1
DIPOLE_ERROR = 0.05
FIELD_ERROR = 0.1
MAGNETOMETER_ERROR = 0.02
"""Prior relative errors of inertia, dipole per ampere, field, and the magnetometer's scale factor."""
DURATION = 200.0
"""Default duration (s) of the flight: pauses, and each manoeuvre once in each of its two directions."""
_MOTION = tuple(NAMES.index(name) for name in ("gain", "torsion", "damping"))
_TIE = np.array([-1.0, 1.0, 1.0, -1.0, 0.0, 0.0])
"""Coefficients of ln J, ln n A, ln B, ln g, kappa and delta in the constraint."""


@dataclass(frozen=True, slots=True)
class PriorValue:
    """A prior value and its relative standard deviation."""

    value: float
    error: float


@dataclass(frozen=True, slots=True)
class PlantPrior:
    """Prior values of the constants, which are known before the flight.

    Attributes:
        inertia: kg m^2.
        dipole: dipole per commanded ampere of the coil on body x, n A, m^2.
        field: T.
        magnetometer_error: relative standard deviation of the magnetometer's scale factor.
    """

    inertia: PriorValue
    dipole: PriorValue
    field: PriorValue
    magnetometer_error: float


@dataclass(frozen=True, slots=True)
class ScaledValue:
    """An estimated value, its standard deviation, and the contribution of its own prior.

    The attribute `own_prior` is the derivative of the value's logarithm with respect to the logarithm of its
    prior, which is 1 if the motion added no information. The attribute is None for a value without a prior.
    """

    value: float
    sigma: float
    own_prior: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AbsolutePlant:
    """Absolute constants of the plant in `knightcube.gnc.guidance.plant`, with uncertainties.

    Attributes:
        inertia: kg m^2.
        dipole: dipole per commanded ampere, n A, m^2.
        field: T.
        torque_constant: torque per current, n A B, N m/A, at theta = 0.
        stiffness: N m/rad.
        damping: N m s/rad.
        field_measured: whether the magnetometer contributed to the field.
        covariance: covariance (6, 6) of ln inertia, ln dipole, ln field, ln gain, torsion and damping; the
            fit determines the last three.
    """

    inertia: ScaledValue
    dipole: ScaledValue
    field: ScaledValue
    torque_constant: ScaledValue
    stiffness: ScaledValue
    damping: ScaledValue
    field_measured: bool
    covariance: FloatArray

    def sources(self) -> dict[str, str]:
        """Return a text about the sources of each constant, by the name of the constant."""
        ratio = "from the motion, multiplied by the inertia"
        found = {"torque_constant": ratio, "stiffness": ratio, "damping": ratio}
        prior = "magnetometer and prior" if self.field_measured else "prior"
        for name, own, others in (
            ("inertia", "prior", "dipole and field"),
            ("dipole", "prior", "inertia and field"),
            ("field", prior, "inertia and dipole"),
        ):
            share = 100.0 * (getattr(self, name).own_prior or 0.0)
            found[name] = f"{share:.0f} % {own}, {100.0 - share:.0f} % motion with {others}"
        return found


def absolute(found: PlantFit, prior: PlantPrior, measured: HorizontalField | None) -> AbsolutePlant:
    """Return the plant from a fit, prior values and the measured field."""
    values = prior.inertia, prior.dipole, _field(prior, measured)
    fitted = found.constants
    mean = np.array(
        [*(math.log(one.value) for one in values), math.log(fitted.gain), fitted.torsion, fitted.damping]
    )
    per_unit = np.array([1.0 / fitted.gain, 1.0, 1.0])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([one.error**2 for one in values])
    covariance[3:, 3:] = found.covariance[np.ix_(_MOTION, _MOTION)] * np.outer(per_unit, per_unit)
    spread = float(_TIE @ covariance @ _TIE)
    correction = covariance @ _TIE / spread
    mean = mean - correction * float(_TIE @ mean)
    shares = [1.0 - float(covariance[i, i]) / spread for i in range(3)]
    covariance = covariance - np.outer(correction, _TIE @ covariance)
    inertia, dipole, strength = (float(value) for value in np.exp(mean[:3]))
    torsion, damping = float(mean[4]), float(mean[5])
    sigma = [math.sqrt(float(covariance[i, i])) for i in range(3)]

    def scaled(value: float, gradient: dict[int, float]) -> ScaledValue:
        by = np.zeros(len(covariance))
        by[list(gradient)] = list(gradient.values())
        return ScaledValue(value, math.sqrt(float(by @ covariance @ by)))

    return AbsolutePlant(
        inertia=ScaledValue(inertia, inertia * sigma[0], shares[0]),
        dipole=ScaledValue(dipole, dipole * sigma[1], shares[1]),
        field=ScaledValue(strength, strength * sigma[2], shares[2]),
        torque_constant=scaled(dipole * strength, {1: dipole * strength, 2: dipole * strength}),
        stiffness=scaled(inertia * torsion, {0: inertia * torsion, 4: inertia}),
        damping=scaled(inertia * damping, {0: inertia * damping, 5: inertia}),
        field_measured=measured is not None,
        covariance=covariance,
    )


def _field(prior: PlantPrior, measured: HorizontalField | None) -> PriorValue:
    """Return the field as the weighted mean of its prior value and the magnetometer's value."""
    own = prior.field
    if measured is None or measured.magnitude <= 0.0:
        return own
    error = math.hypot(prior.magnetometer_error, measured.sigma / measured.magnitude)
    weights = np.array([own.error, error]) ** -2.0
    logarithm = weights @ np.log([own.value, measured.magnitude]) / np.sum(weights)
    return PriorValue(float(np.exp(logarithm)), float(np.sum(weights) ** -0.5))


def excitation_config(config: TestbedConfig, duration: float) -> TestbedConfig:
    """Return `config` changed for identification: `duration` s of excitation, without camera and paths."""
    return configuration.replace(
        config,
        name=f"identify {config.name}"[:64],
        camera=None,
        guidance=configuration.replace(config.guidance, strategy="step"),
        control=configuration.replace(config.control, tracker="excitation"),
        steps=(Step(at=0.0, q2=0.0),),
        duration=duration,
    )


def config_text(config: TestbedConfig) -> str:
    """Return a configuration as text for `flight.schema.reader`."""
    return to_yaml(msgspec.to_builtins(config))


def prior_of(config: TestbedConfig) -> PlantPrior:
    """Return the prior values of a configuration with their errors."""
    plant = config.plant
    return PlantPrior(
        inertia=PriorValue(plant.inertia, INERTIA_ERROR),
        dipole=PriorValue(plant.coil_turns * plant.coil_area, DIPOLE_ERROR),
        field=PriorValue(plant.field, FIELD_ERROR),
        magnetometer_error=MAGNETOMETER_ERROR,
    )


def configured_constants(config: TestbedConfig) -> MotionConstants:
    """Return the configured constants of the motion, each divided by the configured inertia."""
    plant = config.plant
    gain = plant.coil_turns * plant.coil_area * plant.field / plant.inertia
    stiffness, damping = plant.thread_stiffness / plant.inertia, plant.thread_damping / plant.inertia
    return MotionConstants(gain, stiffness, damping)


def noise_of(config: TestbedConfig) -> MotionNoise:
    """Return the noise levels from a configuration, which are the initial values of a fit."""
    unit = config.inertial_unit
    return MotionNoise(max(config.estimation.current_noise, 1e-4), unit.angle_noise, unit.rate_noise)


def plant_section(plant: AbsolutePlant, coil_turns: int) -> Plant:
    """Return the section `plant` of a configuration. Negative stiffness or damping is set to zero."""
    return Plant(
        inertia=plant.inertia.value,
        coil_turns=coil_turns,
        coil_area=plant.dipole.value / coil_turns,
        field=plant.field.value,
        thread_stiffness=max(plant.stiffness.value, 0.0),
        thread_damping=max(plant.damping.value, 0.0),
    )


def plant_text(plant: AbsolutePlant, coil_turns: int, origin: str) -> str:
    """Return the section `plant` as YAML text with uncertainties, sources and the flight `origin`."""
    section, sources = plant_section(plant, coil_turns), plant.sources()
    area = replace(plant.dipole, sigma=plant.dipole.sigma / coil_turns)
    text = [f"# Made by `knightcube identify` from {origin}; +- is 1 sigma.", "plant:"]
    for name, found, unit, source in (
        ("inertia", plant.inertia, "kg m^2", sources["inertia"]),
        ("coil_turns", None, "", ""),
        ("coil_area", area, "m^2", sources["dipole"]),
        ("field", plant.field, "T", sources["field"]),
        ("thread_stiffness", plant.stiffness, "N m/rad", sources["stiffness"]),
        ("thread_damping", plant.damping, "N m s/rad", sources["damping"]),
    ):
        value = getattr(section, name)
        if found is None:
            number, comment = str(value), "from the configuration"
        elif found.value < 0.0:
            number = f"{value:.6e}"
            comment = f"{unit}: the fit gives {found.value:.2g} +- {found.sigma:.2g}, set to zero"
        else:
            number, comment = f"{value:.6e}", f"{unit} +- {found.sigma:.2g}: {source}"
        text.append(f"  {name + ': ' + number:34s}# {comment}")
    return "\n".join(text) + "\n"
