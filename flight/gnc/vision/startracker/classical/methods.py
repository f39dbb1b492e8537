"""All methods of identification by name, the default among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from flight.gnc.vision.startracker.classical import (
    angle_matching,
    grid,
    pyramid,
    rate_matching,
    triangle_matching,
    voting,
)
from flight.gnc.vision.startracker.classical.known_sky import KnownSky
from flight.gnc.vision.startracker.identification import lost_in_space
from flight.gnc.vision.startracker.identification.field import StarField
from flight.gnc.vision.startracker.identification.identification import Identification
from flight.gnc.vision.startracker.index.sky_index import SkyIndex

DEFAULT_METHOD = "default"


@dataclass(frozen=True, slots=True)
class Method:
    """A method of identification.

    Attributes:
        identify: takes a field and what is known of the sky; of a badly known scale all but the default raise
            FieldUnknown.
        source: where it is from.
    """

    identify: Callable[[StarField, KnownSky], Identification]
    source: str


def _default(field: StarField, sky: KnownSky) -> Identification:
    return lost_in_space.identify(field, sky.index)


def method_of(name: str) -> Callable[[StarField, SkyIndex], Identification]:
    """Return the method `name` of METHODS as `SolveSettings` takes it: its tables are made for each field."""
    method = METHODS[name]

    def identify(field: StarField, index: SkyIndex) -> Identification:
        return method.identify(field, KnownSky(index, field.half_width))

    return identify


METHODS: dict[str, Method] = {
    DEFAULT_METHOD: Method(_default, "triangles by shape, turning and size, all at once; votes"),
    "angle": Method(angle_matching.identify, "Gottlieb 1978"),
    "spherical-triangle": Method(triangle_matching.identify_spherical, "Cole & Crassidis 2004"),
    "planar-triangle": Method(triangle_matching.identify_planar, "Cole & Crassidis 2006"),
    "pyramid": Method(pyramid.identify, "Mortari et al. 2004"),
    "rate": Method(rate_matching.identify, "Samaan, Mortari & Junkins 2005"),
    "voting": Method(voting.identify, "Kolomenkin et al. 2008"),
    "grid": Method(grid.identify, "Padgett & Kreutz-Delgado 1997"),
}
