"""The Basilisk simulation of one spacecraft: modules, messages and their connections.

Basilisk's own modules compute the dynamics, the gravity with J2, the gravity gradient, the magnetic field
(WMM), drag, solar pressure and eclipses. The package `sim_hal` provides the properties of the craft, the
orbital elements, the Earth's orientation and the Sun's position. The simulation uses no data that Basilisk
downloads from the network.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pygeomag
from Basilisk.architecture import messaging
from Basilisk.simulation import (
    GravityGradientEffector,
    MtbEffector,
    eclipse,
    exponentialAtmosphere,
    facetDragDynamicEffector,
    facetSRPDynamicEffector,
    gravityEffector,
    magneticFieldWMM,
    spacecraft,
    sphericalHarmonicsGravityModel,
)
from Basilisk.utilities import SimulationBaseClass

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.orientation import celestial_to_terrestrial
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from sim_hal.settings import Disturbances
from sim_hal.worlds.basilisk import STEP_NS
from sim_hal.worlds.free_body import DRAG_COEFFICIENT, TrueCraft
from sim_hal.worlds.orbit import KeplerianElements, sun_position

MASS = 1.0
"""Mass (kg), which affects only the decay of the orbit."""
_DENSITY, _SCALE_HEIGHT, _HEIGHT = 0.8 * 6.967e-13, 63_822.0, 500e3
"""Mean air density (kg/m^3) at the height `_HEIGHT` (m), and scale height (m), from Vallado, Table 8-4."""
_MAX_DIPOLE = 10.0
"""Dipole limit (A m^2) of each torque bar, larger than every sum of coil dipole and residual dipole."""
_TASK = "craft"


class BasiliskScenario:
    """A spacecraft in Basilisk; the simulation's time begins at zero and advances in steps of 25 ms."""

    def __init__(
        self,
        craft: TrueCraft,
        multiples: Disturbances,
        elements: KeplerianElements,
        attitude: FloatArray,
        utc_ns: int,
    ) -> None:
        self._multiples = multiples
        self._simulation = SimulationBaseClass.SimBaseClass()
        self._simulation.CreateNewProcess("world").addTask(self._simulation.CreateNewTask(_TASK, STEP_NS))
        self._earth = messaging.SpicePlanetStateMsg()
        self._sun = messaging.SpicePlanetStateMsg()
        self._command = messaging.MTBCmdMsg()
        self._dynamics: list[Any] = []
        self.craft = _spacecraft(craft, elements, attitude)
        self.craft.gravField.gravBodies = spacecraft.GravBodyVector([self._gravity()])
        self.shadow = self._shadow()
        self.field = self._field(utc_ns)
        self.air = self._air()
        self._effectors(craft)
        modules = [self.shadow, self.field, self.air, *self._dynamics, self.craft]
        for module in modules:
            self._simulation.AddModelToTask(_TASK, module)
        self.place_bodies(UNIX_EPOCH + utc_ns * 1e-9 / DAY, 0)
        self.set_dipole((0.0, 0.0, 0.0), 0)
        self._simulation.InitializeSimulation()

    def run_to(self, time_ns: int) -> None:
        """Run the simulation to a time that is a whole number of steps after its start."""
        self._simulation.ConfigureStopTime(time_ns)
        self._simulation.ExecuteSimulation()

    def place_bodies(self, julian_date: float, time_ns: int) -> None:
        """Give Basilisk the Earth's orientation and the Sun's position at a Julian date (UTC)."""
        earth = messaging.SpicePlanetStateMsgPayload()
        earth.PlanetName, earth.computeOrient = "earth", 1
        earth.J20002Pfix = celestial_to_terrestrial(julian_date).tolist()
        self._earth.write(earth, time_ns)
        far = messaging.SpicePlanetStateMsgPayload()
        far.PlanetName, far.PositionVector = "sun", sun_position(julian_date).tolist()
        self._sun.write(far, time_ns)

    def set_dipole(self, dipole: tuple[float, float, float], time_ns: int) -> None:
        """Set the sum (3,) of coil dipole and residual dipole, A m^2, body axes."""
        command = messaging.MTBCmdMsgPayload()
        command.mtbDipoleCmds = list(dipole)
        self._command.write(command, time_ns)

    def set_rotation(self, attitude: FloatArray, rate: FloatArray) -> None:
        """Set the craft's attitude quaternion (4,) and rotation rate (3,), rad/s."""
        states = self.craft.dynManager
        states.getStateObject(self.craft.hub.nameOfHubSigma).setState(_column(rodrigues(attitude)))
        states.getStateObject(self.craft.hub.nameOfHubOmega).setState(_column(rate))

    def _gravity(self) -> Any:
        model = sphericalHarmonicsGravityModel.SphericalHarmonicsGravityModel()
        model.muBody, model.radEquator, model.maxDeg = GRAVITATIONAL_PARAMETER, EARTH_RADIUS, 2
        # The normalised coefficient is C20 = -J2 / sqrt(5).
        model.cBar = [[1.0], [0.0, 0.0], [-J2 / math.sqrt(5.0), 0.0, 0.0]]
        model.sBar = [[0.0], [0.0, 0.0], [0.0, 0.0, 0.0]]
        body = gravityEffector.GravBodyData()
        body.planetName, body.isCentralBody = "earth", True
        body.mu, body.radEquator = GRAVITATIONAL_PARAMETER, EARTH_RADIUS
        body.gravityModel = model
        body.planetBodyInMsg.subscribeTo(self._earth)
        return body

    def _shadow(self) -> Any:
        module = eclipse.Eclipse()
        module.sunInMsg.subscribeTo(self._sun)
        module.addPlanetToModel(self._earth)
        module.addSpacecraftToModel(self.craft.scStateOutMsg)
        return module

    def _field(self, utc_ns: int) -> Any:
        when = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC)
        epoch = messaging.EpochMsgPayload()
        epoch.year, epoch.month, epoch.day = when.year, when.month, when.day
        epoch.hours, epoch.minutes, epoch.seconds = when.hour, when.minute, float(when.second)
        self._epoch = messaging.EpochMsg().write(epoch)
        module = magneticFieldWMM.MagneticFieldWMM()
        module.configureWMMFile(str(Path(pygeomag.__file__).parent / "wmm" / "WMM_2025.COF"))
        module.planetRadius = 6_371_200.0
        module.epochInMsg.subscribeTo(self._epoch)
        module.planetPosInMsg.subscribeTo(self._earth)
        module.addSpacecraftToModel(self.craft.scStateOutMsg)
        return module

    def _air(self) -> Any:
        module = exponentialAtmosphere.ExponentialAtmosphere()
        module.planetRadius, module.scaleHeight = EARTH_RADIUS, _SCALE_HEIGHT
        module.baseDensity = _DENSITY * math.exp(_HEIGHT / _SCALE_HEIGHT)
        module.planetPosInMsg.subscribeTo(self._earth)
        module.addSpacecraftToModel(self.craft.scStateOutMsg)
        return module

    def _effectors(self, craft: TrueCraft) -> None:
        bars = messaging.MTBArrayConfigMsgPayload()
        bars.numMTB, bars.GtMatrix_B = 3, np.eye(3).ravel().tolist()
        bars.maxMtbDipoles = [_MAX_DIPOLE] * 3
        self._bars = messaging.MTBArrayConfigMsg().write(bars)
        coils = MtbEffector.MtbEffector()
        coils.mtbParamsInMsg.subscribeTo(self._bars)
        coils.mtbCmdInMsg.subscribeTo(self._command)
        coils.magInMsg.subscribeTo(self.field.envOutMsgs[0])
        self._dynamics.append(coils)
        if self._multiples.gravity_gradient:
            gradient = GravityGradientEffector.GravityGradientEffector()
            gradient.addPlanetName("earth")
            self._dynamics.append(gradient)
        drag = facetDragDynamicEffector.FacetDragDynamicEffector()
        drag.atmoDensInMsg.subscribeTo(self.air.envOutMsgs[0])
        light = facetSRPDynamicEffector.FacetSRPDynamicEffector()
        light.setNumFacets(len(craft.faces))
        light.setNumArticulatedFacets(0)
        light.sunInMsg.subscribeTo(self._sun)
        light.sunEclipseInMsg.subscribeTo(self.shadow.eclipseOutMsgs[0])
        for face in craft.faces:
            normal, arm = np.array(face.normal), np.array(face.arm)
            drag.addFacet(self._multiples.drag * face.area, DRAG_COEFFICIENT, normal, arm)
            area = self._multiples.solar_pressure * face.area
            light.addFacet(area, np.eye(3), normal, np.array([1.0, 0.0, 0.0]), arm, 0.0, face.mirrored)
        self._dynamics += [drag, light]
        for effector in self._dynamics:
            self.craft.addDynamicEffector(effector)


def _spacecraft(craft: TrueCraft, elements: KeplerianElements, attitude: FloatArray) -> Any:
    made = spacecraft.Spacecraft()
    made.ModelTag = "craft"
    turn = quaternion.attitude_matrix(craft.to_principal)
    made.hub.mHub = MASS
    made.hub.r_BcB_B = _column(np.zeros(3))
    made.hub.IHubPntBc_B = (turn.T @ np.diag(craft.inertia) @ turn).tolist()
    position, velocity = elements.state()
    made.hub.r_CN_NInit, made.hub.v_CN_NInit = _column(position), _column(velocity)
    made.hub.sigma_BNInit, made.hub.omega_BN_BInit = _column(rodrigues(attitude)), _column(np.zeros(3))
    return made


def _column(vector: FloatArray) -> list[list[float]]:
    return [[float(part)] for part in vector]


def rodrigues(attitude: FloatArray) -> FloatArray:
    """Return the modified Rodrigues parameters (3,) of a quaternion (4,), for the shorter rotation."""
    q = attitude if attitude[3] >= 0.0 else -attitude
    return np.asarray(q[:3] / (1.0 + q[3]))
