"""The first guess of one horizon: the camera's position and its orientation about nadir, before the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.horizon.azimuth import Orientation, orientation, turned
from knightcube.vision.horizon.consensus import ConeCandidate
from knightcube.vision.horizon.ellipsoid import MEAN_RADIUS, Ellipsoid, earth, mean_sphere
from knightcube.vision.horizon.illumination import agreement
from knightcube.vision.horizon.knowledge import HorizonKnowledge
from knightcube.vision.horizon.limb_equation import View
from knightcube.vision.horizon.limb_fit import UNKNOWN
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT
from knightcube.vision.horizon.observation import Observation
from knightcube.vision.horizon.settings import HorizonSettings

SPHERE_ALTITUDE_SIGMA = 10e3
"""m: error of an altitude above the mean sphere that the Earth's flattening causes."""
_TURNS = 24


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """The camera's position, as far as known.

    Attributes:
        position: (3,) m, inertial axes where the real one is known.
        surface: ellipsoid or sphere.
        altitude_sigma: m, infinite where the altitude is unknown.
        located: whether the position is the real one.
    """

    position: FloatArray
    surface: Ellipsoid
    altitude_sigma: float
    located: bool

    @property
    def cosine(self) -> float:
        """The cosine of the half-angle of the limb's cone, taken for circular with the radius below."""
        distance = float(np.linalg.norm(self.position))
        radius = distance - self.surface.height_of(self.position) + UNIT_DEPTH_HEIGHT
        return float(np.sqrt(1.0 - min(1.0, radius / distance) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class InitialGuess:
    """The start of a horizon's fit.

    Attributes:
        place: assumed place of the camera.
        view: start of the fit.
        orientation: of the camera about nadir.
        members: (n,) the picture's edges that may lie on it.
    """

    place: Place
    view: View
    orientation: Orientation
    members: BoolArray


def cosine_at(altitude: float) -> float:
    """Return the cosine of the half-angle of the limb's cone from `altitude` m above the mean sphere."""
    return _above_sphere(altitude, 0.0).cosine


def place_of(knowledge: HorizonKnowledge, settings: HorizonSettings) -> Place | None:
    """Return the known place of the camera; None if its altitude is unknown."""
    if knowledge.position is not None:
        position = np.asarray(knowledge.position, dtype=float)
        return Place(position, earth(knowledge.pole), settings.altitude_sigma, True)
    if knowledge.altitude is not None:
        return _above_sphere(knowledge.altitude, SPHERE_ALTITUDE_SIGMA)
    return None


def _above_sphere(altitude: float, sigma: float) -> Place:
    return Place(np.array([0.0, 0.0, MEAN_RADIUS + altitude]), mean_sphere(), sigma, False)


def initial_guess(
    candidate: ConeCandidate,
    seen: Observation,
    place: Place | None,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
) -> InitialGuess:
    """Return the guess that a cone gives; `place` is None if the altitude is unknown."""
    if place is None:
        sine = float(np.sqrt(max(1.0 - candidate.cosine**2, 1e-6)))
        place = _above_sphere((MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / sine - MEAN_RADIUS, UNKNOWN)
    view, stand = _first_view(candidate, seen, place, knowledge)
    return InitialGuess(place, view, stand, candidate.members)


def sun_from(place: Place, knowledge: HorizonKnowledge) -> FloatArray | None:
    """Return the unit vector (3,) to the Sun in the axes of the place; None if either is unknown."""
    if knowledge.sun is None or not place.located:
        return None
    return np.asarray(knowledge.sun / np.linalg.norm(knowledge.sun))


def _first_view(
    candidate: ConeCandidate,
    seen: Observation,
    place: Place,
    knowledge: HorizonKnowledge,
) -> tuple[View, Orientation]:
    """Return the first view and its orientation; on a sphere if the turn about nadir is unknown."""
    down = -place.position / np.linalg.norm(place.position)
    nothing = HorizonKnowledge()
    stand = orientation(candidate.direction, down, knowledge if place.located else nothing)
    height = UNIT_DEPTH_HEIGHT
    view = View(stand.rotation, place.position, place.surface, height)
    if np.isfinite(stand.sigma):
        return view, stand
    distance = float(np.linalg.norm(place.position))
    radius = distance - place.surface.height_of(place.position)
    view = replace(view, surface=Ellipsoid(place.surface.pole, radius, radius))
    sun = sun_from(place, knowledge)
    if sun is None:
        return view, stand
    turns = [
        replace(view, rotation=turned(stand.rotation, candidate.direction, angle))
        for angle in np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)
    ]
    looks = [agreement(each, sun, seen.samples) for each in turns]
    best = int(
        np.argmin([look.stray * look.dark_samples + look.missing * look.lit_samples for look in looks])
    )
    return turns[best], replace(stand, rotation=turns[best].rotation)
