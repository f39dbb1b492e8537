"""Where middle and axis of a solved picture point, what is in it, and its world coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ground.sky.bodies import Body
from ground.sky.world_coordinates import world_coordinates
from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.sky_map import SkyMap

# px: axis and middle of the picture are named apart beyond it.
_SAME_PX = 0.1


def sky_facts(sky: SkyMap | None, bodies: Sequence[Body]) -> dict[str, Any]:
    """Return where middle and axis point, the bodies and the world coordinates, for `--json`."""
    if sky is None:
        return {}
    camera = sky.camera
    middle = 0.5 * (camera.columns - 1), 0.5 * (camera.rows - 1)
    return {
        "image_centre": _place_facts(sky, middle),
        "axis": _place_facts(sky, camera.centre),
        "bodies": [
            {"name": body.name, **_coordinates(body.direction), "point_px": body.point.tolist()}
            for body in bodies
        ],
        "wcs": world_coordinates(sky),
    }


def _place_facts(sky: SkyMap, point: tuple[float, float]) -> dict[str, Any]:
    return {**_coordinates(sky.directions(np.array([point]))[0]), "point_px": list(point)}


def _coordinates(direction: FloatArray) -> dict[str, float]:
    right_ascension = math.degrees(math.atan2(direction[1], direction[0])) % 360.0
    declination = math.degrees(math.atan2(direction[2], math.hypot(direction[0], direction[1])))
    return {"right_ascension_deg": right_ascension, "declination_deg": declination}


def sky_text(sky: SkyMap | None, bodies: Sequence[Body]) -> str:
    """Return the same for a reader: lines, none of what is not there."""
    if sky is None:
        return ""
    values, lines = sky_facts(sky, bodies), []
    if math.dist(values["axis"]["point_px"], values["image_centre"]["point_px"]) > _SAME_PX:
        # Right ascension and declination above are those of the axis.
        centre, (x, y) = values["image_centre"], values["axis"]["point_px"]
        lines.append(f"axis:             at pixel {x:.1f}, {y:.1f}")
        place = f"{centre['right_ascension_deg']:.4f} {centre['declination_deg']:+.4f} deg"
        lines.append(f"image centre:     {place}")
    for body in bodies:
        x, y = body.point
        lines.append(f"in the picture:   {body.name} at pixel {x:.1f}, {y:.1f}")
    return "".join(line + "\n" for line in lines)
