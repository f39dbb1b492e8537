"""KnightCube: attitude determination, vision and magnetic control of small satellites, as a library.

    from knightcube import StarTracker

    solution = StarTracker(fov_deg=11.4).solve(image)

The names exported here are the public interface. The submodules of `knightcube` can also be imported, but
their interfaces may change with any release. The package `knightcube` uses no clock, configuration file,
device or socket.

Each name is imported at its first use, so that `import knightcube` takes almost no time. A new name must be
added both to the imports below, which are for type checkers and editors, and to the table `_MODULE_OF`, which
is for the interpreter.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from knightcube.astro.almanac import magnetic_field as magnetic_field
    from knightcube.astro.almanac import magnetic_field_on_ground as magnetic_field_on_ground
    from knightcube.astro.almanac import orbit_state as orbit_state
    from knightcube.astro.almanac import propagate_elements as propagate_elements
    from knightcube.astro.almanac import propagate_orbit as propagate_orbit
    from knightcube.astro.almanac import sun_direction as sun_direction
    from knightcube.astro.almanac import sunlit_fraction as sunlit_fraction
    from knightcube.astro.earth.geomagnetism import GeomagneticError as GeomagneticError
    from knightcube.astro.earth.orbit_knowledge import OrbitError as OrbitError
    from knightcube.errors import ArgumentError as ArgumentError
    from knightcube.errors import InputError as InputError
    from knightcube.errors import KnightCubeError as KnightCubeError
    from knightcube.errors import PlanningError as PlanningError
    from knightcube.errors import UsageError as UsageError
    from knightcube.gnc.control.detumble import Detumbler as Detumbler
    from knightcube.gnc.control.detumble import DetumblerSettings as DetumblerSettings
    from knightcube.gnc.control.detumble import WindowSchedule as WindowSchedule
    from knightcube.gnc.control.pointing_job import plan_pointing as plan_pointing
    from knightcube.gnc.control.pointing_law import PointingLaw as PointingLaw
    from knightcube.gnc.control.pointing_table import PointingWeights as PointingWeights
    from knightcube.gnc.estimation.attitude_filter import AttitudeFilter as AttitudeFilter
    from knightcube.gnc.estimation.attitude_filter import AttitudeFilterSettings as AttitudeFilterSettings
    from knightcube.gnc.estimation.consistency import Consistency as Consistency
    from knightcube.gnc.estimation.consistency import attitude_error as attitude_error
    from knightcube.gnc.estimation.consistency import check_consistency as check_consistency
    from knightcube.gnc.estimation.estimate import AttitudeMeasurement as AttitudeMeasurement
    from knightcube.gnc.estimation.estimate import DirectionMeasurement as DirectionMeasurement
    from knightcube.gnc.estimation.estimate import FieldMeasurement as FieldMeasurement
    from knightcube.gnc.estimation.estimate import MeanRateMeasurement as MeanRateMeasurement
    from knightcube.gnc.estimation.estimate import RateMeasurement as RateMeasurement
    from knightcube.gnc.estimation.field_rate import FieldRate as FieldRate
    from knightcube.gnc.estimation.field_rate import FieldRateSettings as FieldRateSettings
    from knightcube.gnc.estimation.rigid_body import RigidBody as RigidBody
    from knightcube.gnc.guidance.plant import SingleAxisPlant as SingleAxisPlant
    from knightcube.gnc.guidance.pointing_target import Goal as Goal
    from knightcube.gnc.guidance.pointing_target import PointingTarget as PointingTarget
    from knightcube.gnc.guidance.slew_plan import plan_slew as plan_slew
    from knightcube.gnc.guidance.vmc import plan_step as plan_step
    from knightcube.vision.camera.images import read_image as read_image
    from knightcube.vision.camera.lens import Lens as Lens
    from knightcube.vision.camera.lens import LensError as LensError
    from knightcube.vision.camera.lens import Pinhole as Pinhole
    from knightcube.vision.horizon.nadir import find_nadir as find_nadir
    from knightcube.vision.horizon.settings import HorizonKnowledge as HorizonKnowledge
    from knightcube.vision.lens_calibration import LensCalibration as LensCalibration
    from knightcube.vision.lens_calibration import calibrate_lens as calibrate_lens
    from knightcube.vision.lens_knowledge import CalibrationError as CalibrationError
    from knightcube.vision.objects.detect import detect_objects as detect_objects
    from knightcube.vision.star_tracker import MatchedStars as MatchedStars
    from knightcube.vision.star_tracker import StarSolution as StarSolution
    from knightcube.vision.star_tracker import StarTracker as StarTracker
    from knightcube.vision.streaks.estimate import estimate_rate as estimate_rate
    from knightcube.vision.sun import find_sun as find_sun

_MODULE_OF = {
    "ArgumentError": "knightcube.errors",
    "AttitudeFilter": "knightcube.gnc.estimation.attitude_filter",
    "AttitudeFilterSettings": "knightcube.gnc.estimation.attitude_filter",
    "AttitudeMeasurement": "knightcube.gnc.estimation.estimate",
    "CalibrationError": "knightcube.vision.lens_knowledge",
    "Consistency": "knightcube.gnc.estimation.consistency",
    "Detumbler": "knightcube.gnc.control.detumble",
    "DetumblerSettings": "knightcube.gnc.control.detumble",
    "DirectionMeasurement": "knightcube.gnc.estimation.estimate",
    "FieldMeasurement": "knightcube.gnc.estimation.estimate",
    "FieldRate": "knightcube.gnc.estimation.field_rate",
    "FieldRateSettings": "knightcube.gnc.estimation.field_rate",
    "GeomagneticError": "knightcube.astro.earth.geomagnetism",
    "Goal": "knightcube.gnc.guidance.pointing_target",
    "HorizonKnowledge": "knightcube.vision.horizon.settings",
    "InputError": "knightcube.errors",
    "KnightCubeError": "knightcube.errors",
    "Lens": "knightcube.vision.camera.lens",
    "LensCalibration": "knightcube.vision.lens_calibration",
    "LensError": "knightcube.vision.camera.lens",
    "MatchedStars": "knightcube.vision.star_tracker",
    "MeanRateMeasurement": "knightcube.gnc.estimation.estimate",
    "OrbitError": "knightcube.astro.earth.orbit_knowledge",
    "Pinhole": "knightcube.vision.camera.lens",
    "PlanningError": "knightcube.errors",
    "PointingLaw": "knightcube.gnc.control.pointing_law",
    "PointingTarget": "knightcube.gnc.guidance.pointing_target",
    "PointingWeights": "knightcube.gnc.control.pointing_table",
    "RateMeasurement": "knightcube.gnc.estimation.estimate",
    "RigidBody": "knightcube.gnc.estimation.rigid_body",
    "SingleAxisPlant": "knightcube.gnc.guidance.plant",
    "StarSolution": "knightcube.vision.star_tracker",
    "StarTracker": "knightcube.vision.star_tracker",
    "UsageError": "knightcube.errors",
    "WindowSchedule": "knightcube.gnc.control.detumble",
    "attitude_error": "knightcube.gnc.estimation.consistency",
    "calibrate_lens": "knightcube.vision.lens_calibration",
    "check_consistency": "knightcube.gnc.estimation.consistency",
    "detect_objects": "knightcube.vision.objects.detect",
    "estimate_rate": "knightcube.vision.streaks.estimate",
    "find_nadir": "knightcube.vision.horizon.nadir",
    "find_sun": "knightcube.vision.sun",
    "magnetic_field": "knightcube.astro.almanac",
    "magnetic_field_on_ground": "knightcube.astro.almanac",
    "orbit_state": "knightcube.astro.almanac",
    "plan_pointing": "knightcube.gnc.control.pointing_job",
    "plan_slew": "knightcube.gnc.guidance.slew_plan",
    "plan_step": "knightcube.gnc.guidance.vmc",
    "propagate_elements": "knightcube.astro.almanac",
    "propagate_orbit": "knightcube.astro.almanac",
    "read_image": "knightcube.vision.camera.images",
    "sun_direction": "knightcube.astro.almanac",
    "sunlit_fraction": "knightcube.astro.almanac",
}

_EXTRA_OF = {"erfa": "orbit", "nlopt": "vmc", "pygeomag": "orbit", "sgp4": "orbit"}
"""Names of optional packages, and for each the optional dependency group of KnightCube that installs it."""


def _public(name: str) -> Any:
    """Import and return the public object called `name`.

    Raises AttributeError for an unknown name. Raises ImportError, with the command that installs the package,
    if an optional package is missing.
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


if not TYPE_CHECKING:
    # Type checkers do not see these lines: with `__getattr__` they would accept any name, and they cannot
    # evaluate this `__all__`.
    __all__ = list(_MODULE_OF)
    __getattr__ = _public


def __dir__() -> list[str]:
    """Return the names of the module, including public names that are not imported yet."""
    return sorted({*globals(), *_MODULE_OF})
