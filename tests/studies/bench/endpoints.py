"""Single endpoints, faint streaks and mid-exposure attitude of the likelihood fit, beside their bounds.

`python -m tests.studies.bench endpoints`: three tables, seeds of their own. The quantities and their
references are described in `single_endpoints`, `faint_streaks`, `mid_exposure`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.studies.bench import faint_streaks, mid_exposure, single_endpoints
from tests.studies.bench.faint_streaks import WANTED, faint_frame
from tests.studies.bench.mid_exposure import attitude_row
from tests.studies.bench.single_endpoints import STARS, endpoint_cell, pooled_bias

_SEED = 14_142


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _print_cell(cell: dict[str, Any]) -> None:
    head = f"{cell['magnitude']:9.0f} {cell['length']:5.0f} {cell['ends']:5d}/{cell['of']:<5d}"
    if "bias" not in cell:
        _say(f"{head} too few found to say more")
        return
    joint, lone = cell["over_joint"], cell["over_lone"]
    _say(
        f"{head}"
        f" {cell['bound_along']:8.3f}   {joint[0]:5.2f} {joint[1]:5.2f}   {lone[0]:5.2f} {lone[1]:5.2f}"
        f"   {cell['bias']:+.4f} +- {cell['bias_error']:.4f}"
    )


def _print_endpoints(options: argparse.Namespace) -> dict[str, Any]:
    if not options.json:
        _say(f"endpoints, {STARS} streaks a frame, {single_endpoints.EXPOSURE:g} s, theta 90 deg")
        _say("                               bound     over the bound of (along, across)")
        _say("magnitude    px  found      along px   all together  one alone     bias along, px")
    cells, biases = [], []
    for magnitude in options.magnitude:
        row = []
        for length in options.length:
            row.append(endpoint_cell(magnitude, length, options.frames, options.seed))
            if not options.json:
                _print_cell(row[-1])
        cells += row
        pooled = pooled_bias(row)
        if pooled is None:
            continue
        bias, error = pooled
        biases.append({"magnitude": magnitude, "bias": bias, "bias_error": error})
        if not options.json:
            _say(f"{magnitude:9.0f}   all{'bias':>55} {bias:+.4f} +- {error:.4f}")
    return {"endpoints": cells, "bias": biases}


def _print_faint(options: argparse.Namespace) -> dict[str, Any]:
    frames = [faint_frame(frame, options.seed) for frame in range(options.faint_frames)]
    found, false, misplaced = (sum(f[key] for f in frames) for key in ("found", "false", "misplaced"))
    if not options.json:
        _say(
            f"\nfaint streaks, magnitude 4 to 6, 20 to 200 px, {WANTED} a frame of the real sky, "
            f"{faint_streaks.EXPOSURE:g} s"
        )
        for f in frames:
            missed = ", ".join(f"V {m['magnitude']:.2f} {m['length']:.0f} px" for m in f["missed"])
            _say(
                f"theta {f['theta']:4.0f}, {f['length']:4.0f} px: {f['status']}, found {f['found']},"
                f" false {f['false']}, misplaced {f['misplaced']} of {f['seen']}"
                + (f"; missed {missed}" if missed else "")
            )
        _say(
            f"found {found} of {WANTED * len(frames)}, false {false / len(frames):.1f} a frame (median"
            f" {np.median([f['false'] for f in frames]):.0f}), misplaced {misplaced / len(frames):.1f}"
        )
    facts = {"found": found, "of": WANTED * len(frames), "false": false, "misplaced": misplaced}
    return {"faint": {**facts, "frames": frames}}


def _print_attitudes(options: argparse.Namespace) -> dict[str, Any]:
    rows = [
        attitude_row(percent, options.attitude_frames, options.seed, options.faintest, options.exposure)
        for percent in options.percent
    ]
    if not options.json:
        _say(
            f"\nattitude at mid-exposure, across the boresight, {options.exposure:g} s,"
            f" stars to V {options.faintest:g}"
        )
        _say("turn %  solution     rates  rms px  median  largest  bound px  rms x bound  median x bound")
        for row in rows:
            for name, one in row["solutions"].items():
                _print_solution(row, name, one)
            if row["attitudes"]:
                claimed = ", ".join(f"{name} {ratio:.2f}" for name, ratio in row["over_claimed"].items())
                rates = ", ".join(f"{name} fit {ratio:.2f}" for name, ratio in row["rate_over_bound"].items())
                _say(
                    f"        {100 * row['dropped']:.0f} % of the stars do not agree;"
                    f" rms over its own sigma: {claimed}; rate, vector, x bound: {rates}"
                )
    return {"exposure": options.exposure, "attitude": rows}


def _print_solution(row: dict[str, Any], name: str, one: dict[str, Any]) -> None:
    if not one["attitudes"]:
        return
    _say(
        f"{row['percent']:6.0f}  {name:10} {one['attitudes']:3d}/{row['frames']:<3d}"
        f" {one['rms_px']:7.4f} {one['median_px']:7.4f} {one['largest_px']:8.4f}"
        f" {row['bound_px']:9.4f} {one['over_bound']:12.2f} {one['over_bound_median']:15.2f}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, or one JSON object; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tables = {"endpoints": _print_endpoints, "faint": _print_faint, "attitude": _print_attitudes}
    parser.add_argument("--only", choices=sorted(tables), help="one table instead of all three")
    parser.add_argument(
        "--frames", type=int, default=15, help="of each cell of endpoints (default %(default)s)"
    )
    parser.add_argument("--faint-frames", type=int, default=10, help="default %(default)s")
    parser.add_argument("--attitude-frames", type=int, default=20, help="for each turn (default %(default)s)")
    parser.add_argument("--magnitude", type=float, nargs="+", default=[1.0, 2.0, 3.0, 4.0, 5.0])
    parser.add_argument("--length", type=float, nargs="+", default=[20.0, 50.0, 100.0, 200.0], help="px")
    parser.add_argument("--percent", type=float, nargs="+", default=[10.0, 20.0, 35.0, 50.0], help="turns")
    parser.add_argument(
        "--faintest",
        type=float,
        default=8.5,
        help="star in the sky of the attitudes, V (default %(default)s; the bound knows of no hidden light)",
    )
    parser.add_argument(
        "--exposure",
        type=float,
        default=mid_exposure.EXPOSURE,
        help="s, of the attitudes (default %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    options = parser.parse_args(arguments)
    if options.frames < 2 or min(options.faint_frames, options.attitude_frames) < 1:
        parser.error("--frames must be at least 2, the other numbers of frames at least 1")
    if not options.exposure > 0.0:
        parser.error("--exposure must be positive")
    facts: dict[str, Any] = {"seed": options.seed}
    if not options.json:
        _say(f"seed {options.seed}")
    for name, table in tables.items():
        if options.only in (None, name):
            facts |= table(options)
    if options.json:
        _say(json.dumps(facts))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
