"""Command `knightcube plan`, which plans a slew of the testbed or, with --orbit, of a satellite."""

from __future__ import annotations

import argparse
import math
import sys
import time
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np

from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig
from flight.schema.document import config_path
from ground.commands.options import CONFIG_HELP, check_picture, finite, positive, print_result, utc
from knightcube import plan_slew, plan_step
from knightcube.astro.quaternion import angle_between, attitude_matrix, conjugate, multiply
from knightcube.errors import UsageError
from knightcube.gnc.guidance.plant import Q2_LIMIT, PathCost, SingleAxisPlant, angle_of
from knightcube.gnc.guidance.pointing_target import NUMBERS, Goal, PointingTarget
from knightcube.gnc.guidance.slew_model import HORIZON_RANGE as SLEW_HORIZON_RANGE
from knightcube.gnc.guidance.slew_model import MINIMUM_TIME, BoresightEnd
from knightcube.gnc.guidance.slew_model import NODES as SLEW_NODES
from knightcube.gnc.guidance.slew_model import NODES_RANGE as SLEW_NODES_RANGE
from knightcube.gnc.guidance.slew_plan import STRETCH, OrderedSlew, SlewStatus
from knightcube.gnc.guidance.vmc import FASTEST, HORIZON_RANGE, NODES, NODES_RANGE, StepPlan

BODIES: tuple[Literal["sun", "earth", "moon"], ...] = ("sun", "earth", "moon")
_OFF_UNIT = 0.1  # largest deviation from 1 of the norm of a given quaternion, which the command normalises
_DEFAULT_CONFIG = "step_demo"
_TESTBED_ONLY = ("from_rate", "to_rate", "horizon", "cost", "config")  # options that only testbed slews have
_ORBIT_ONLY = ("at", "within", "longest", "window", "least_time", *(f"{name}_cone" for name in BODIES))
"""Options that only slews in orbit have."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube plan` to the parser."""
    parser.description = (
        "Plan the least-energy slew between two attitudes, of the testbed by virtual motion camouflage, or "
        "with --orbit of a satellite in three axes; print it or draw it. A horizon that is too short is "
        "stretched to the shortest feasible one."
    )
    parser.epilog = (
        "example: knightcube plan --from 0.4 --from-rate 0.015 --to -0.3 --picture path.png; in orbit: "
        "knightcube plan --orbit orbit --from nadir --to sun --at 2026-03-01T12:00:00 --within 600"
    )
    text = "q2 = sin(angle / 2) at the start, or a target such as nadir with --orbit"
    parser.add_argument("--from", dest="start", required=True, metavar="Q2", help=text)
    text = "q2 at the end, or a target such as sun with --orbit"
    parser.add_argument("--to", dest="end", required=True, metavar="Q2", help=text)
    parser.add_argument("--from-rate", type=finite, metavar="W", help="rad/s at the start (default 0)")
    parser.add_argument("--to-rate", type=finite, metavar="W", help="rad/s at the end (default 0)")
    _add_options(parser)
    _add_orbit_options(parser)
    parser.set_defaults(command=run)


def _add_options(parser: argparse.ArgumentParser) -> None:
    text = "duration of the slew, s (default: `guidance.horizon`)"
    parser.add_argument("--horizon", type=finite, metavar="S", help=text)
    text = "cost of time, W: choose the horizon of least energy plus this cost times the horizon"
    parser.add_argument("--time-price", type=positive, metavar="W", help=text)
    text = "energy to minimise: R I^2 of the mean current (heat), or V |I| from the supply"
    parser.add_argument("--cost", choices=[cost.value for cost in PathCost], help=text)
    parser.add_argument("--nodes", type=int, metavar="N", help=f"nodes of the path (default {NODES})")
    text = f"configuration of the testbed: {CONFIG_HELP} (default {_DEFAULT_CONFIG})"
    parser.add_argument("--config", type=config_path, metavar="CONFIG", help=text)
    parser.add_argument("--json", action="store_true", help="print one JSON object, with the nodes")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="draw the path, its rate and its current")


def run(options: argparse.Namespace) -> int:
    """Plan a slew, and print and draw the result."""
    in_orbit = options.orbit is not None
    check_picture("--picture", options.picture, options.config, options.orbit)
    for name in _TESTBED_ONLY if in_orbit else _ORBIT_ONLY:
        if getattr(options, name) not in (None, False):
            option = name.replace("_", "-")
            raise UsageError(f"--{option}: cannot be used {'with' if in_orbit else 'without'} --orbit")
    return _run_orbit(options) if in_orbit else _run_testbed(options)


def _run_testbed(options: argparse.Namespace) -> int:
    start, end = _q2("--from", options.start), _q2("--to", options.end)
    _check(options)
    config = configuration.load_testbed(options.config or config_path(_DEFAULT_CONFIG))
    plant = plant_of(config)
    begun = time.perf_counter()
    made = plan_step(
        plant,
        start_angle=angle_of(start),
        start_rate=options.from_rate or 0.0,
        end_angle=angle_of(end),
        end_rate=options.to_rate or 0.0,
        horizon=config.guidance.horizon if options.horizon is None else options.horizon,
        nodes=options.nodes or config.guidance.nodes or NODES,
        time_cost=options.time_price,
        minimise=options.cost or config.guidance.cost,
    )
    solved_s = time.perf_counter() - begun
    print_result(options, _facts(made, plant, solved_s), _text(made, plant, solved_s))
    if options.picture is not None:
        from ground.report import draw_path  # noqa: PLC0415

        draw_path(made, plant, options.picture)
        if not options.json:
            sys.stdout.write(f"picture:       {options.picture}\n")
    return 0


def _facts(made: StepPlan, plant: SingleAxisPlant, solved_s: float) -> dict[str, object]:
    angle, rate, acceleration = made.path.motion(np.minimum(made.node_times, made.horizon * (1 - 1e-12)))
    return {
        "status": made.status.value,
        "horizon_asked_s": made.horizon_asked,
        "horizon_s": made.horizon,
        "energy_J": made.energy,
        "supply_energy_J": made.supplied,
        "mean_supply_power_W": made.supplied / made.horizon,
        "peak_current_A": made.peak_current,
        "current_limit_A": plant.current_limit,
        "evaluations": made.evaluations,
        "solved_s": solved_s,
        "time_s": made.node_times.tolist(),
        "q2": made.node_q2.tolist(),
        "rate_rad_s": rate.tolist(),
        "current_A": plant.currents(angle, rate, acceleration).tolist(),
        "path_control_parameter": made.nu.tolist(),
    }


def _text(made: StepPlan, plant: SingleAxisPlant, solved_s: float) -> str:
    stretched = f" ({made.horizon_asked:g} s is too short)" if made.horizon > made.horizon_asked else ""
    return (
        f"status:        {made.status.value}\n"
        f"horizon:       {made.horizon:.3f} s{stretched}\n"
        f"energy:        {made.energy:.5f} J, integral of R I^2\n"
        f"supply:        {made.supplied:.5f} J, integral of V |I|\n"
        f"mean supply:   {1e3 * made.supplied / made.horizon:.2f} mW\n"
        f"peak current:  {made.peak_current:.4f} A of {plant.current_limit:.4f} A\n"
        f"solved in:     {1e3 * solved_s:.1f} ms, {made.evaluations} evaluations\n"
    )


def _q2(option: str, text: str) -> float:
    """Return the quaternion component q2 that a text states. Raises UsageError for a value out of range."""
    try:
        value = finite(text)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"{option}: {error}; targets need --orbit") from error
    if not abs(value) <= Q2_LIMIT:
        raise UsageError(f"{option} {value:g}: must be {-Q2_LIMIT:g} to {Q2_LIMIT:g}")
    return value


def _check(options: argparse.Namespace) -> None:
    for option, value, (low, high, unit) in (
        ("--from-rate", options.from_rate, (-FASTEST, FASTEST, " rad/s")),
        ("--to-rate", options.to_rate, (-FASTEST, FASTEST, " rad/s")),
        ("--horizon", options.horizon, (*HORIZON_RANGE, " s")),
        ("--nodes", options.nodes, (*NODES_RANGE, "")),
    ):
        _check_range(option, value, low, high, unit)
    if options.time_price is not None and options.horizon is not None:
        raise UsageError(f"--horizon {options.horizon:g}: --time-price chooses the horizon: give one of them")


def _check_range(option: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Raise UsageError for an option whose value is given and out of range."""
    if value is not None and not low <= value <= high:
        raise UsageError(f"{option} {value:g}: must be {low:g} to {high:g}{unit}")


def _add_orbit_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("with --orbit")
    text = (
        f"plan a slew of this satellite ({CONFIG_HELP}); --from and --to are then targets: "
        "nadir, velocity, sun, 'inertial QX QY QZ QW', 'ground LAT LON', each with 'roll DEG' or a free roll"
    )
    group.add_argument("--orbit", type=config_path, metavar="CONFIG", help=text)
    group.add_argument("--at", type=utc, metavar="UTC", help="start of the slew, such as 2026-03-01T12:00:00")
    group.add_argument("--within", type=positive, metavar="S", help="duration of the slew, s")
    text = f"longest stretched slew, s (default {STRETCH:g} times --within, up to {SLEW_HORIZON_RANGE[1]:g})"
    group.add_argument("--longest", type=positive, metavar="S", help=text)
    text = "start at the best time within this time after --at, s (default 0)"
    group.add_argument("--window", type=finite, metavar="S", help=text)
    group.add_argument(
        "--least-time", action="store_true", help="plan the slew of least duration instead of least energy"
    )
    for name in BODIES:
        text = f"keep the star camera this far from the {name.capitalize()}" + (
            "'s limb" if name == "earth" else ""
        )
        group.add_argument(f"--{name}-cone", type=positive, metavar="DEG", help=text)


def _run_orbit(options: argparse.Namespace) -> int:
    if options.at is None or options.within is None:
        raise UsageError("--orbit needs --at UTC and --within S")
    config = configuration.load_orbit(options.orbit)
    at = options.at
    if config.elements is None:
        raise UsageError(f"{options.orbit}: `elements` is missing: make it with `knightcube elements`")
    begun = time.process_time()
    made = _planned(options, config, config.elements, at)
    solved_s = time.process_time() - begun
    facts = _orbit_facts(made, at, solved_s) | _visibility(made, config.elements, at)
    path = made.plan.path
    nodes = {
        "time_s": path.times.tolist(),
        "quaternion": path.quaternion.tolist(),
        "rate_rad_s": path.rate.tolist(),
        "dipole_A_m2": path.dipole.tolist(),
    }
    print_result(options, facts | nodes, _orbit_text(facts))
    if options.picture is not None:
        from ground.report import draw_slew  # noqa: PLC0415

        draw_slew(made, made.order, options.picture)
        if not options.json:
            sys.stdout.write(f"picture:       {options.picture}\n")
    return 0


def _planned(
    options: argparse.Namespace, config: OrbitConfig, elements: tuple[str, str], at: datetime
) -> OrderedSlew:
    """Return the planned slew that the options describe. Raises UsageError."""
    if options.least_time and options.time_price is not None:
        raise UsageError("--least-time and --time-price: give one of them")
    _check_range("--nodes", options.nodes, *SLEW_NODES_RANGE)
    low, high = SLEW_HORIZON_RANGE
    longest = min(STRETCH * options.within, high) if options.longest is None else options.longest
    if not low <= options.within <= longest <= high:
        given = f"--within {options.within:g}, --longest {longest:g}"
        raise UsageError(f"{given}: must be {low:g} to {high:g} s, and --within not above --longest")
    for name in BODIES:
        if (cone := getattr(options, f"{name}_cone")) is not None and cone >= 180.0:
            raise UsageError(f"--{name}-cone {cone:g}: must be above 0 and below 180 deg")
    cones: dict[Literal["sun", "earth", "moon"], float] = {
        name: math.radians(value)
        for name in BODIES
        if (value := getattr(options, f"{name}_cone")) is not None
    }
    if cones and config.camera is None:
        raise UsageError(f"{options.orbit}: has no `camera`, to which an exclusion cone applies")
    boresight = np.array(config.pointing.axis)
    if config.camera is not None:
        boresight = attitude_matrix(np.array(config.camera.mounting))[2]
    coils = config.coils.map()
    return plan_slew(
        inertia=config.craft.inertia_matrix(),
        dipole_limit=coils.limits,
        heat=coils.heat,
        elements=elements,
        time=at,
        start=_target("--from", options.start),
        goal=_target("--to", options.end),
        duration=options.within,
        longest=longest,
        window=options.window or 0.0,
        time_cost=MINIMUM_TIME if options.least_time else options.time_price,
        pointing_axis=config.pointing.axis,
        across_axis=config.pointing.across,
        camera_axis=boresight,
        cones=cones,
        nodes=SLEW_NODES if options.nodes is None else options.nodes,
    )


def _target(option: str, text: str) -> PointingTarget:
    """Return the pointing target that a text such as 'nadir roll 10' describes. Raises UsageError."""
    words = text.split()
    try:
        goal = Goal.named(words[0] if words else "")
        if goal is Goal.OBJECT:
            raise UsageError(
                "the direction of an object is known only in flight: no slew to it can be planned"
            )
        split = 1 + NUMBERS.get(goal, (0,))[-1]
        numbers, rest = [finite(word) for word in words[1:split]], words[split:]
        roll = math.radians(finite(rest[1])) if len(rest) == 2 and rest[0] == "roll" else None
        if rest and roll is None:
            raise UsageError(f"{' '.join(rest)!r} is not a roll: give 'roll DEG'")
        if goal is Goal.INERTIAL and len(numbers) == 4 and abs(math.hypot(*numbers) - 1.0) <= _OFF_UNIT:
            numbers = [number / math.hypot(*numbers) for number in numbers]
        elif goal is Goal.GROUND:
            numbers = [math.radians(number) for number in numbers]
        return PointingTarget(goal, tuple(numbers), roll)
    except (UsageError, argparse.ArgumentTypeError) as error:
        raise UsageError(f"{option} {text!r}: {error}") from error


def _orbit_facts(made: OrderedSlew, at: datetime, solved_s: float) -> dict[str, object]:
    plan, path, task = made.plan, made.plan.path, made.task
    begin = at + timedelta(seconds=made.begin)
    around = multiply(path.quaternion[-1], conjugate(path.quaternion[0]))
    speed = np.linalg.norm(path.rate, axis=1)
    return {
        "status": plan.status.value,
        "from": made.order.held.text,
        "to": made.order.goal.text,
        "begin_utc": begin.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "begins_compared": made.compared,
        "horizon_asked_s": plan.horizon_asked,
        "horizon_s": plan.horizon,
        "energy_J": plan.energy,
        "mean_heat_W": plan.energy / plan.horizon,
        "peak_of_limit": plan.peak,
        "dipole_limit_A_m2": made.task.craft.limit.tolist(),
        "turn_deg": math.degrees(float(angle_between(path.quaternion[0], path.quaternion[-1]))),
        # The path's quaternion is continuous: its scalar part changes sign after a rotation by 180 deg.
        "way_round": "short" if around[3] >= 0.0 else "long",
        "way_deg": math.degrees(float(np.trapezoid(speed, path.times))),
        "peak_rate_deg_s": math.degrees(float(speed.max())),
        "clearance_deg": {
            cone.name.lower(): math.degrees(clear)
            for cone, clear in zip(task.cones, plan.clearance, strict=True)
        },
        "roll_free": isinstance(task.end(plan.horizon), BoresightEnd),
        "steps": plan.steps,
        "processor_s": solved_s,
    }


def _visibility(made: OrderedSlew, elements: tuple[str, str], at: datetime) -> dict[str, object]:
    """Return the elevation (deg) of the satellite at the end of a slew to a target on the ground."""
    goal = made.order.goal
    if goal.goal is not Goal.GROUND:
        return {}
    from ground.passes import OrbitPrediction, Station  # noqa: PLC0415 - loads Skyfield

    latitude, longitude = (math.degrees(number) for number in goal.numbers)
    place = Station(name="target", latitude_deg=latitude, longitude_deg=longitude)
    end = at + timedelta(seconds=made.begin + made.plan.horizon)
    return {"elevation_deg": OrbitPrediction(elements, end, 0.1).elevation(place, end)}


def _orbit_text(facts: dict[str, object]) -> str:
    stretched = facts["status"] == SlewStatus.STRETCHED.value
    note = f" ({facts['horizon_asked_s']:g} s is too short)" if stretched else ""
    begins = facts["begins_compared"]
    chosen = "" if begins == 1 else f", the best of {begins} start times"
    clear, limits = facts["clearance_deg"], facts["dipole_limit_A_m2"]
    assert isinstance(clear, dict)
    assert isinstance(limits, list)
    largest = ", ".join(f"{name} {limit:.4g}" for name, limit in zip("xyz", limits, strict=True))
    seen = ""
    if "elevation_deg" in facts:
        elevation = float(str(facts["elevation_deg"]))
        hidden = ": the Earth hides it" if elevation < 0.0 else ""
        seen = f"target:        elevation of the satellite {elevation:.1f} deg at the end{hidden}\n"
    kept = "".join(f"{name + ':':15}{value:.2f} deg outside its cone\n" for name, value in clear.items())
    return (
        f"status:        {facts['status']}\n"
        f"slew:          from {facts['from']} to {facts['to']}\n"
        f"begin:         {facts['begin_utc']}{chosen}\n"
        f"horizon:       {facts['horizon_s']:.3f} s{note}\n"
        f"energy:        {facts['energy_J']:.5f} J, integral of R I^2\n"
        f"peak dipole:   {100.0 * float(str(facts['peak_of_limit'])):.1f} % of the limit\n"
        f"dipole limits: {largest} A m^2\n"
        f"rotation:      {facts['turn_deg']:.2f} deg, the {facts['way_round']} way, "
        f"on a path of {facts['way_deg']:.1f} deg\n"
        f"peak rate:     {facts['peak_rate_deg_s']:.3f} deg/s\n"
        f"{kept}{seen}"
        f"solved in:     {facts['processor_s']:.2f} s of processor time, {facts['steps']} steps\n"
    )
