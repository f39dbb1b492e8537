"""`flight plan --orbit`: one slew in three axes with coils alone, with its cost and its picture."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np

from flight.schema import reader as configuration
from flight.schema.document import config_path
from flight.schema.orbit import OrbitConfig, as_orbit
from ground.commands.options import finite, positive
from knightcube import plan_slew
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_between, attitude_matrix, conjugate, multiply
from knightcube.errors import UsageError
from knightcube.gnc.guidance.planners import STRETCH
from knightcube.gnc.guidance.three_axes.pointing_target import NUMBERS, Goal, PointingTarget
from knightcube.gnc.guidance.three_axes.slew_model import (
    HORIZON_RANGE,
    MINIMUM_TIME,
    NODES,
    BoresightEnd,
)
from knightcube.gnc.guidance.three_axes.slew_plan import OrderedSlew, SlewStatus

BODIES: tuple[Literal["sun", "earth", "moon"], ...] = ("sun", "earth", "moon")
_OFF_UNIT = 0.1
"""A typed quaternion is scaled to length 1 when its length is within this of 1."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of slews in orbit."""
    group = parser.add_argument_group("with --orbit")
    group.add_argument(
        "--orbit",
        type=config_path,
        metavar="CONFIG",
        help="plan a slew of this satellite, a file or a carried name; --from and --to are then targets: "
        "nadir, velocity, sun, 'inertial QX QY QZ QW', 'ground LAT LON', each with 'roll DEG' or a free roll",
    )
    group.add_argument("--at", metavar="UTC", help="when the slew begins, such as 2026-03-01T12:00:00")
    group.add_argument("--within", type=positive, metavar="S", help="how long the slew takes, seconds")
    group.add_argument(
        "--longest", type=positive, metavar="S", help=f"stretched at most to (default {STRETCH:g} times that)"
    )
    group.add_argument(
        "--window",
        type=finite,
        metavar="S",
        help="begin at the best time within so long after --at (default 0)",
    )
    group.add_argument(
        "--least-time", action="store_true", help="the shortest slew, in place of least energy"
    )
    for name in BODIES:
        group.add_argument(
            f"--{name}-cone",
            type=positive,
            metavar="DEG",
            help=f"keep the star camera so far from the {name.capitalize()}"
            + ("'s limb" if name == "earth" else ""),
        )


ONLY = ("at", "within", "longest", "window", "least_time", *(f"{name}_cone" for name in BODIES))
"""Options that have no meaning without --orbit."""


def run(options: argparse.Namespace) -> int:
    """Plan, print, draw."""
    if options.at is None or options.within is None:
        raise UsageError("--orbit needs --at UTC and --within S")
    config = as_orbit(configuration.load(options.orbit))
    at = _utc(options.at)
    if config.elements is None:
        raise UsageError(f"{options.orbit}: `elements` is missing: without them the orbit is not known")
    begun = time.process_time()
    made = _planned(options, config, config.elements, at)
    solved_s = time.process_time() - begun
    facts = _facts(made, at, solved_s)
    sys.stdout.write(
        json.dumps(facts | _nodes(made), allow_nan=False) + "\n" if options.json else _text(facts)
    )
    if options.picture is not None:
        _draw(made, options)
    return 0


def _draw(made: OrderedSlew, options: argparse.Namespace) -> None:
    from ground.report import draw_slew  # noqa: PLC0415

    draw_slew(made, made.order, options.picture)
    if not options.json:
        sys.stdout.write(f"picture:       {options.picture}\n")


def _planned(
    options: argparse.Namespace, config: OrbitConfig, elements: tuple[str, str], at: datetime
) -> OrderedSlew:
    """Return the slew of the options. Raises UsageError."""
    if options.least_time and options.time_price is not None:
        raise UsageError("--least-time and --time-price: give one of them")
    longest = STRETCH * options.within if options.longest is None else options.longest
    low, high = HORIZON_RANGE
    if not low <= options.within <= longest <= high:
        raise UsageError(f"--within {options.within:g}, longest {longest:g}: must be {low:g} to {high:g}")
    cones: dict[Literal["sun", "earth", "moon"], float] = {
        name: math.radians(value)
        for name in BODIES
        if (value := getattr(options, f"{name}_cone")) is not None
    }
    if cones and config.camera is None:
        raise UsageError(f"{options.orbit}: it has no `camera` that a cone could be kept for")
    per_ampere, coils = config.craft.dipole_per_ampere, config.coils
    return plan_slew(
        inertia=np.diag(config.craft.inertia),
        dipole_limit=np.full(3, coils.current_limit * per_ampere),
        heat=np.array(coils.resistance) / per_ampere**2,
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
        camera_axis=_boresight(config),
        cones=cones,
        nodes=options.nodes or NODES,
    )


def _boresight(config: OrbitConfig) -> FloatArray:
    """Return the star camera's boresight (3,) in the body, the pointing axis without a camera."""
    if config.camera is None:
        return np.array(config.pointing.axis)
    return np.asarray(attitude_matrix(np.array(config.camera.mounting))[2])


def _target(option: str, text: str) -> PointingTarget:
    """Return the target that words name. Raises UsageError."""
    words = text.split()
    try:
        goal = Goal.named(words[0] if words else "")
        if goal is Goal.OBJECT:
            raise UsageError("an object is found in flight: no slew can be planned to it")
        split = 1 + NUMBERS.get(goal, (0,))[-1]
        numbers, rest = [finite(word) for word in words[1:split]], words[split:]
        roll = math.radians(finite(rest[1])) if len(rest) == 2 and rest[0] == "roll" else None
        if rest and roll is None:
            raise UsageError(f"{' '.join(rest)!r} is no roll: give 'roll DEG'")
        if goal is Goal.INERTIAL and len(numbers) == 4 and abs(math.hypot(*numbers) - 1.0) <= _OFF_UNIT:
            numbers = [number / math.hypot(*numbers) for number in numbers]
        elif goal is Goal.GROUND:
            numbers = [math.radians(number) for number in numbers]
        return PointingTarget(goal, tuple(numbers), roll)
    except (UsageError, argparse.ArgumentTypeError) as error:
        raise UsageError(f"{option} {text!r}: {error}") from error


def _utc(text: str) -> datetime:
    """Return the time that a text gives, UTC unless it says otherwise. Raises UsageError."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError as error:
        raise UsageError(f"--at {text!r}: give a time such as 2026-03-01T12:00:00") from error
    return found.replace(tzinfo=UTC) if found.tzinfo is None else found.astimezone(UTC)


def _facts(made: OrderedSlew, at: datetime, solved_s: float) -> dict[str, object]:
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
        "turn_deg": math.degrees(float(angle_between(path.quaternion[0], path.quaternion[-1]))),
        # The path's quaternion is continuous: past half a turn its scalar part has changed its sign.
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


def _nodes(made: OrderedSlew) -> dict[str, object]:
    path = made.plan.path
    return {
        "time_s": path.times.tolist(),
        "quaternion": path.quaternion.tolist(),
        "rate_rad_s": path.rate.tolist(),
        "dipole_A_m2": path.dipole.tolist(),
        "dipole_limit_A_m2": made.task.craft.limit.tolist(),
    }


def _text(facts: dict[str, object]) -> str:
    stretched = facts["status"] == SlewStatus.STRETCHED.value
    note = f" (asked: {facts['horizon_asked_s']:g} s, too short)" if stretched else ""
    begins = facts["begins_compared"]
    chosen = "" if begins == 1 else f", the best of {begins} begins"
    clear = facts["clearance_deg"]
    assert isinstance(clear, dict)
    kept = "".join(f"{name + ':':15}{value:.2f} deg outside its cone\n" for name, value in clear.items())
    return (
        f"status:        {facts['status']}\n"
        f"slew:          from {facts['from']} to {facts['to']}\n"
        f"begin:         {facts['begin_utc']}{chosen}\n"
        f"horizon:       {facts['horizon_s']:.3f} s{note}\n"
        f"energy:        {facts['energy_J']:.5f} J, integral of R I^2\n"
        f"peak dipole:   {100.0 * float(str(facts['peak_of_limit'])):.1f} % of the limit\n"
        f"turn:          {facts['turn_deg']:.2f} deg, the {facts['way_round']} way round, "
        f"on a way of {facts['way_deg']:.1f} deg\n"
        f"peak rate:     {facts['peak_rate_deg_s']:.3f} deg/s\n"
        f"{kept}"
        f"solved in:     {facts['processor_s']:.2f} s of processor time, {facts['steps']} steps\n"
    )
