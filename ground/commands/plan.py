"""`flight plan`: one path by virtual motion camouflage, with its cost; with --orbit a slew in three axes."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from flight.schema.document import config_path
from ground.commands import plan_orbit
from ground.commands.options import finite, positive
from knightcube import plan_step
from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT, PathCost, SingleAxisPlant, angle_of
from knightcube.gnc.guidance.one_axis.vmc import FASTEST, HORIZON_RANGE, NODES, NODES_RANGE, StepPlan

_DEFAULT_CONFIG = "step_demo"
_ONLY = ("from_rate", "to_rate", "horizon", "cost", "config")
"""Options that have no meaning with --orbit."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Plan the least-energy slew between two attitudes, of the testbed by virtual motion camouflage, or "
        "with --orbit of a satellite in three axes; print it or draw it. A horizon that is too short is "
        "stretched to the shortest feasible one."
    )
    parser.epilog = (
        "example: python -m flight plan --from 0.4 --from-rate 0.015 --to -0.3 --picture path.png; in orbit: "
        "python -m flight plan --orbit orbit --from nadir --to sun --at 2026-03-01T12:00:00 --within 600"
    )
    parser.add_argument(
        "--from", dest="start", required=True, metavar="Q2", help="q2 at the start; with --orbit a target"
    )
    parser.add_argument(
        "--to", dest="end", required=True, metavar="Q2", help="q2 at the end; with --orbit a target"
    )
    parser.add_argument("--from-rate", type=finite, metavar="W", help="rad/s at the start (default 0)")
    parser.add_argument("--to-rate", type=finite, metavar="W", help="rad/s at the end (default 0)")
    _add_options(parser)
    plan_orbit.configure(parser)
    parser.set_defaults(command=run)


def _add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that may be left out."""
    parser.add_argument("--horizon", type=finite, metavar="S", help="seconds (default: the configuration's)")
    parser.add_argument(
        "--time-price",
        type=positive,
        metavar="W",
        help="price of time: choose the horizon of least energy plus price times time",
    )
    parser.add_argument(
        "--cost",
        choices=[cost.value for cost in PathCost],
        help="energy to save: R I^2 of the mean current (heat), or V |I| from the supply",
    )
    parser.add_argument("--nodes", type=int, metavar="N", help=f"nodes of the path (default {NODES})")
    parser.add_argument(
        "--config",
        type=config_path,
        metavar="CONFIG",
        help=f"configuration of the plant, a file or a carried name (default {_DEFAULT_CONFIG})",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, with the nodes")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="draw the path, its rate and its current")


def run(options: argparse.Namespace) -> int:
    """Plan, print, draw."""
    in_orbit = options.orbit is not None
    for name in _ONLY if in_orbit else plan_orbit.ONLY:
        if getattr(options, name) not in (None, False):
            option = name.replace("_", "-")
            raise UsageError(f"--{option}: has no meaning {'with' if in_orbit else 'without'} --orbit")
    return plan_orbit.run(options) if in_orbit else _run(options)


def _run(options: argparse.Namespace) -> int:
    """Plan the testbed's path, print, draw."""
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
    if options.json:
        sys.stdout.write(json.dumps(_facts(made, plant, solved_s), allow_nan=False) + "\n")
    else:
        sys.stdout.write(_text(made, plant, solved_s))
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
    stretched = f" (asked: {made.horizon_asked:g} s, too short)" if made.horizon > made.horizon_asked else ""
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
    """Return a q2 within the thread's range. Raises UsageError."""
    try:
        value = finite(text)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"{option}: {error}; targets need --orbit") from error
    if not abs(value) <= Q2_LIMIT:
        raise UsageError(f"{option} {value:g}: must be {-Q2_LIMIT:g} to {Q2_LIMIT:g}")
    return value


def _check(options: argparse.Namespace) -> None:
    """Raise UsageError for an option that no plan can follow."""
    for option, value, (low, high) in (
        ("--from-rate", options.from_rate, (-FASTEST, FASTEST)),
        ("--to-rate", options.to_rate, (-FASTEST, FASTEST)),
        ("--horizon", options.horizon, HORIZON_RANGE),
        ("--nodes", options.nodes, NODES_RANGE),
    ):
        if value is not None and not low <= value <= high:
            raise UsageError(f"{option} {value:g}: must be {low:g} to {high:g}")
