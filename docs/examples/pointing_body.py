"""A user-defined body, which points in three axes by quaternion feedback, without a planner.

The configuration names this body as `body: pointing_body:POINTING`. The law is the cross product law of
magnetic control: for the wanted torque T, the dipole is m = (B x T) / |B|^2, so that m x B is the part of T
perpendicular to the field B. The body has the plant of the testbed, and uses the testbed's estimation and
detumbling.

The command `python docs/examples/pointing_body.py` flies the demonstration's first step.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flight.bodies.testbed.body import (
    TestbedEstimation,
    detumbling_law,
    dipole_per_ampere,
    surrounding_field,
)
from flight.bodies.testbed.control import plant_of
from flight.link import events
from flight.link.events import ORBITAL, Mode
from flight.loop.body import (
    COMMANDED,
    KEPT,
    BodyControl,
    BodyKind,
    CoilCommand,
    ControlOutput,
    FlightBody,
    Target,
)
from flight.loop.executive import Cycle, JobResult
from flight.loop.facts import Services
from flight.loop.state import Learned
from flight.schema.bodies import TestbedConfig, as_testbed
from flight.schema.sections import Config
from ground.telemetry import read_run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y, attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.gnc.estimation.estimate import Estimate, MeanRateMeasurement
from knightcube.gnc.guidance.pointing_target import PointingTarget

DUE_NS = 60_000_000_000
"""Time (ns) after which a target should have been reached."""


# --8<-- [start:law]
@dataclass(frozen=True, slots=True)
class FixedAttitude:
    """A `TargetLaw` with a constant attitude."""

    wanted: tuple[float, ...]

    @property
    def text(self) -> str:
        """Text that describes the target attitude in events."""
        return "attitude " + " ".join(f"{part:+.3f}" for part in self.wanted)

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,) to be reached, reference into body."""
        return np.array(self.wanted)


@dataclass(frozen=True, slots=True, eq=False)
class AtRest:
    """A `Reference` with a constant attitude (4,) and zero body rate."""

    quaternion: FloatArray

    @property
    def body_rate(self) -> FloatArray:
        """(3,) rad/s, body axes."""
        return np.zeros(3)


def error_of(estimate: Estimate, wanted: FloatArray) -> FloatArray:
    """Return the rotation (3,), rad, from the wanted to the estimated attitude, body axes."""
    return to_rotation_vector(multiply(estimate.quaternion, conjugate(wanted)))


# --8<-- [end:law]


# --8<-- [start:tracker]
class CrossProductTracker:
    """Implements `Tracker`: quaternion feedback with a current limit that keeps the dipole's direction."""

    def __init__(self, config: TestbedConfig, reference_field: FloatArray) -> None:
        plant, bandwidth = plant_of(config), config.control.bandwidth
        self._stiffness = plant.inertia * bandwidth**2
        self._damping = 2.0 * 0.9 * plant.inertia * bandwidth
        self._dipole = dipole_per_ampere(config)
        self._limit = plant.current_limit
        self._field = reference_field

    def field(self, estimate: Estimate) -> FloatArray:
        """Return the magnetic field (3,), T, in body axes."""
        return attitude_matrix(estimate.quaternion) @ self._field

    def command(self, estimate: Estimate, reference: AtRest) -> CoilCommand:
        """Return the coil command that rotates the body towards the reference."""
        error = error_of(estimate, reference.quaternion)
        torque = -self._stiffness * error - self._damping * estimate.rate
        field = self.field(estimate)
        currents = np.cross(field, torque) / (field @ field) / self._dipole
        largest = float(np.abs(currents).max())
        if largest > self._limit:
            currents = currents * (self._limit / largest)
        return CoilCommand(self._dipole * currents, currents, largest > self._limit)

    def reset(self) -> None:
        """Nothing is integrated."""


# --8<-- [end:tracker]


# --8<-- [start:paths]
class Direct:
    """Implements `Paths` and `Planner`: the target itself is the reference, without a plan."""

    def __init__(self) -> None:
        self._reference: AtRest | None = None
        self.since_ns = 0

    def hold(self, quaternion: FloatArray, now_ns: int) -> None:
        """Make an attitude (4,) the reference from `now_ns` on."""
        self._reference, self.since_ns = AtRest(quaternion), now_ns

    def sample(self, now_ns: int) -> AtRest | None:
        """Return the reference at `now_ns`, or None before the first target."""
        return self._reference

    def is_following(self, now_ns: int) -> bool:
        """Return whether the body may still be on its way to the target."""
        return now_ns - self.since_ns < DUE_NS

    def is_adrift(self, now_ns: int) -> bool:
        """Return False, because this body needs no plan."""
        return False

    def release(self) -> None:
        """Forget the reference."""
        self._reference = None

    def busy_since_ns(self) -> int | None:
        """Return None, because this body never has a planning job."""
        return None

    def aim(self, target: Target, now_ns: int) -> None:
        """Make the attitude of a target the reference."""
        self.hold(target.law.quaternion(now_ns), now_ns)

    def request(self, now_ns: int) -> None:
        """Plan nothing."""

    def resume(self, now_ns: int) -> None:
        """Plan nothing."""

    def replan(self, cycle: Cycle) -> None:
        """Plan nothing."""

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Make the target the reference again if the reference was released."""
        if self._reference is None:
            self.aim(target, now_ns)

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Accept nothing."""

    def counts(self) -> tuple[int, int]:
        """Return the numbers of accepted and refused plans, which are always zero."""
        return 0, 0


# --8<-- [end:paths]


# --8<-- [start:targets]
class Attitudes:
    """Implements `Targets`: the configured steps as rotations about the thread."""

    def __init__(self, config: TestbedConfig, direct: Direct) -> None:
        self._times = [round(step.at * 1e9) for step in config.steps]
        self._steps = [Target(index, _about_thread(step.q2)) for index, step in enumerate(config.steps)]
        self._direct = direct

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target at a mission time."""
        return self._steps[max(sum(time <= mission_time_ns for time in self._times) - 1, 0)]

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target of a commanded slew."""
        assert not isinstance(wanted, PointingTarget), "this body has no mode POINT"
        return Target(COMMANDED + number, _about_thread(wanted))

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Hold the present attitude."""
        self._direct.hold(estimate.quaternion, now_ns)
        return Target(KEPT, FixedAttitude(tuple(estimate.quaternion.tolist())))

    def can_hold(self, estimate: Estimate) -> bool:
        """Return True, because the coils can rotate the body about the thread in every attitude."""
        return True

    def speed(self, estimate: Estimate) -> float:
        """Return the body rate, rad/s."""
        return float(np.linalg.norm(estimate.rate))

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle between body and target, rad."""
        return float(np.linalg.norm(error_of(estimate, target.law.quaternion(estimate.time_ns))))

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return the error, or None before the time at which the target is due."""
        return None if self._direct.is_following(now_ns) else self.error(estimate, target)


def _about_thread(q2: float) -> FixedAttitude:
    return FixedAttitude(tuple(about_axis_y(2.0 * math.asin(q2)).tolist()))


# --8<-- [end:targets]


# --8<-- [start:view]
class View:
    """Implements `BodyView`: records no packets besides `attitude`, which the loop records for every body."""

    def __init__(self, services: Services) -> None:
        self._events = services.events

    def record_cycle(self, output: ControlOutput) -> None:
        """Record no additional packets."""

    def announce(self, target: Target, now_ns: int) -> None:
        """Report a new target."""
        if target.index != KEPT:
            self._events.report(events.TARGET, now_ns, target.law.text)

    def mode_fields(self, wanted: Target | None) -> Mapping[str, float]:
        """Return the field of the mode packet that depends on the body."""
        return {"target_q2": math.nan}

    def rate_text(self, rate: MeanRateMeasurement) -> str:
        """Return a body rate from streaks as text."""
        return f"rate {rate.rate.round(5).tolist()} rad/s"

    def progress(self, output: ControlOutput | None) -> str:
        """Return the target as text, or an empty text without a target."""
        return output.target.law.text if output is not None and output.target is not None else ""


# --8<-- [end:view]


# --8<-- [start:make]
class PointingControl(BodyControl):
    """Implements `BodyControl` with the classes above, and with the testbed's detumbling law."""

    def __init__(self, config: TestbedConfig) -> None:
        direct = Direct()
        self.modes = frozenset(Mode) - ORBITAL
        self.dipoles = dipole_per_ampere(config) * np.eye(3)
        self.free_axis = np.array([0.0, 1.0, 0.0])
        self.paths = self.planner = direct
        self.targets = Attitudes(config, direct)
        self.tracker = CrossProductTracker(config, surrounding_field(config))
        self.detumbling = detumbling_law(config, plant_of(config))


def make(config: Config, services: Services, learned: Mapping[str, Learned]) -> FlightBody:
    """Return the body of a configuration with the values that were learned before the last boot."""
    config = as_testbed(config)
    return FlightBody(TestbedEstimation(config, learned), PointingControl(config), View(services))


def plan(job: Any) -> Any:
    """Raise NotImplementedError, because this body submits no planning jobs."""
    raise NotImplementedError


POINTING = BodyKind(plan, make)
# --8<-- [end:make]


def main() -> None:
    """Fly the demonstration's first step with this body, and print the final pointing error and body rate."""
    text = Path("config/step_demo.yaml").read_text(encoding="utf-8")
    before, _, after = text.partition("camera: ")
    text = f"{before}camera: none\n\nestimation:" + after.partition("\nestimation:")[2]
    text = text.replace("  tracker: lq", "  bandwidth: 0.6\n  tracker: lq")
    with tempfile.TemporaryDirectory() as name:
        config, folder = Path(name) / "pointing.yaml", Path(name) / "run"
        config.write_text(f"body: pointing_body:POINTING\n{text}", encoding="utf-8")
        here = str(Path(__file__).resolve().parent)
        environment = {**os.environ, "PYTHONPATH": f"{here}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
        words = ["-m", "flight", "run", str(config), "--out", str(folder), "--duration", "45"]
        subprocess.run([sys.executable, *words], env=environment, check=True, stdout=subprocess.DEVNULL)
        last = read_run(folder)["attitude"][-1]
    error = to_rotation_vector(multiply(last["quaternion"], conjugate(last["target"])))
    print(f"pointing error {np.rad2deg(np.linalg.norm(error)):.2f} deg after 45 s")
    print(f"body rate      {np.rad2deg(np.linalg.norm(last['rate'])):.3f} deg/s")


if __name__ == "__main__":
    main()
