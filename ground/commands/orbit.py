"""`flight orbit`: first orbits of the objects that a flight tracked."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from ground.export.orbit_message import write_orbit_messages
from ground.orbits.from_run import ObjectOrbit, orbits_of
from ground.telemetry import read_run

_PLACE, _SPEED = slice(0, 3), slice(3, 6)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Determine a first orbit of each object that a flight tracked, from directions alone, with its "
        "covariance; where the arc is too short, say so with numbers. Exit status 0 when every object has "
        "an orbit, 1 when one has none."
    )
    parser.epilog = "example: python -m flight orbit runs/object --opm orbits"
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--opm", type=Path, metavar="FOLDER", help="write each orbit as a CCSDS Orbit Parameter Message"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Determine, print, write."""
    found = orbits_of(read_run(options.run))
    paths = [] if options.opm is None else write_orbit_messages(found, options.opm)
    if options.json:
        facts = {"objects": [_facts(item) for item in found], "files": [str(path) for path in paths]}
        sys.stdout.write(json.dumps(facts, allow_nan=False) + "\n")
    else:
        sys.stdout.write("".join(map(_text, found)) + "".join(f"{path}\n" for path in paths))
    return 0 if all(item.orbit is not None for item in found) else 1


def _facts(item: ObjectOrbit) -> dict[str, object]:
    facts: dict[str, object] = {"object": item.number, "sightings": item.sightings, "span_s": item.span}
    orbit = item.orbit
    if orbit is None:
        return facts | {"orbit": None, "reason": item.reason}
    return facts | {
        "orbit": {
            "utc": item.date.isoformat(),
            "position_m": orbit.state[:3].tolist(),
            "velocity_m_s": orbit.state[3:].tolist(),
            "covariance": orbit.covariance.tolist(),
            "distance_m": orbit.distance,
            "distance_95_m": list(orbit.interval),
            "lasts": orbit.lasts,
            "chi_square": orbit.chi_square,
            "degrees": orbit.degrees,
        }
    }


def _text(item: ObjectOrbit) -> str:
    head = f"object {item.number}: {item.sightings} sightings in {item.span:.0f} s\n"
    orbit = item.orbit
    if orbit is None:
        return f"{head}  no orbit: {item.reason}\n"
    low, high = (1e-3 * end for end in orbit.interval)
    x, y, z = 1e-3 * orbit.state[:3]
    u, v, w = 1e-3 * orbit.state[3:]
    place, speed = (float(np.sqrt(np.trace(orbit.covariance[part, part]))) for part in (_PLACE, _SPEED))
    lasting = "" if orbit.lasts else "  as it stands it does not last; within its errors it may\n"
    return (
        f"{head}"
        f"  at {item.date:%Y-%m-%dT%H:%M:%S.%f} UTC, ICRS\n"
        f"  position  {x:12.3f} {y:12.3f} {z:12.3f} km   +- {1e-3 * place:.3g} km\n"
        f"  velocity  {u:12.6f} {v:12.6f} {w:12.6f} km/s +- {1e-3 * speed:.3g} km/s\n"
        f"  distance  {1e-3 * orbit.distance:.1f} km, {low:.1f} to {high:.1f} by 95 %\n"
        f"{lasting}"
        f"  chi-square {orbit.chi_square:.0f} with {orbit.degrees} degrees of freedom\n"
    )
