"""All methods of identification by name, the default among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from knightcube.reference.star_identification import (
    angle_matching,
    grid,
    pyramid,
    rate_matching,
    triangle_matching,
    voting,
)
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.search import Propose, search
from knightcube.vision.startracker.identification import lost_in_space
from knightcube.vision.startracker.identification.field import StarField
from knightcube.vision.startracker.identification.identification import Identification
from knightcube.vision.startracker.index.sky_index import SkyIndex

DEFAULT_METHOD = "default"


@dataclass(frozen=True, slots=True)
class Method:
    """A method of identification.

    Attributes:
        identify: of a field, by tables of the sky. All but the default raise FieldUnknown for a scale that is
            too uncertain.
        source: publication.
    """

    identify: Callable[[StarField, KnownSky], Identification]
    source: str


def _default(field: StarField, sky: KnownSky) -> Identification:
    return lost_in_space.identify(field, sky.index)


def method_of(name: str) -> Callable[[StarField, SkyIndex], Identification]:
    """Return the method `name` of METHODS for `SolveSettings`; it builds its tables for each field."""
    method = METHODS[name]

    def identify(field: StarField, index: SkyIndex) -> Identification:
        return method.identify(field, KnownSky(index, field.half_width))

    return identify


def _classical(propose: Propose, source: str) -> Method:
    return Method(partial(search, propose=propose), source)


METHODS: dict[str, Method] = {
    DEFAULT_METHOD: Method(_default, "triangles by shape, turning and size, all at once; votes"),
    "angle": _classical(angle_matching.propose, "Gottlieb 1978"),
    "spherical-triangle": _classical(triangle_matching.propose_spherical, "Cole & Crassidis 2004"),
    "planar-triangle": _classical(triangle_matching.propose_planar, "Cole & Crassidis 2006"),
    "pyramid": _classical(pyramid.propose, "Mortari et al. 2004"),
    "rate": Method(rate_matching.identify, "Samaan, Mortari & Junkins 2005"),
    "voting": _classical(voting.propose, "Kolomenkin et al. 2008"),
    "grid": _classical(grid.propose, "Padgett & Kreutz-Delgado 1997"),
}
