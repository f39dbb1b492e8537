"""KnightCube: attitude determination, vision and magnetic control of small satellites, as a library.

    from knightcube import StarTracker

    solution = StarTracker(fov_deg=11.4).solve(image)

The names exported here are the public interface. The modules below `knightcube` may be imported too, but may
change with any release. Nothing in this package needs a clock, a configuration file, a device or a socket.

A name is imported at its first use, so `import knightcube` takes no time. A new name needs one line in each
of the two lists below: the first is for type checkers and editors, the second for the interpreter.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant as SingleAxisPlant
    from knightcube.gnc.guidance.planners import plan_slew as plan_slew
    from knightcube.gnc.guidance.planners import plan_step as plan_step
    from knightcube.gnc.guidance.three_axes.pointing_target import Goal as Goal
    from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget as PointingTarget
    from knightcube.vision.star_tracker import MatchedStars as MatchedStars
    from knightcube.vision.star_tracker import StarSolution as StarSolution
    from knightcube.vision.star_tracker import StarTracker as StarTracker

_MODULE_OF = {
    "Goal": "knightcube.gnc.guidance.three_axes.pointing_target",
    "MatchedStars": "knightcube.vision.star_tracker",
    "PointingTarget": "knightcube.gnc.guidance.three_axes.pointing_target",
    "SingleAxisPlant": "knightcube.gnc.guidance.one_axis.plant",
    "StarSolution": "knightcube.vision.star_tracker",
    "StarTracker": "knightcube.vision.star_tracker",
    "plan_slew": "knightcube.gnc.guidance.planners",
    "plan_step": "knightcube.gnc.guidance.planners",
}
__all__ = list(_MODULE_OF)

_EXTRA_OF = {"erfa": "orbit", "nlopt": "vmc", "pygeomag": "orbit", "sgp4": "orbit"}
"""Optional packages, and the extra of this distribution that installs each."""


def __getattr__(name: str) -> Any:
    """Return a public name, imported now.

    Raises AttributeError for another name. Raises ImportError if an optional package is missing, with the
    command that installs it.
    """
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(_MODULE_OF[name])
    except ModuleNotFoundError as error:
        if error.name not in _EXTRA_OF:
            raise
        raise ImportError(
            f"{name} needs the package {error.name}: pip install 'knightcube[{_EXTRA_OF[error.name]}]'",
            name=error.name,
        ) from None
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    """Return the names of the module, those not yet imported included."""
    return sorted({*globals(), *_MODULE_OF})
