"""`python -m tests.studies.tune_controllers`: tunes every gain of the baseline controllers by one criterion.

The search minimises R I^2 over the demonstration's steps. Every step must settle (5 % band) within 9 s and
overshoot by at most 1 %, on a thread of 1e-5 N m/rad, which the controllers do not model. The PID controller
has four free gains (angle, integral, rate, target weight). The adaptive controller has three (bandwidth,
adaptation, reference bandwidth). The search uses the method of Nelder and Mead from several starts. It
simulates body and controller only, without noise, with the loop's delay of one cycle.
`tests.studies.campaigns controllers` tests the resulting gains in simulated flights of the whole loop. The
limits leave a margin for noise. `--settling`, `--overshoot` and `--stiffness` change limits and thread.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from knightcube.gnc.control.one_axis import AngleController
from knightcube.gnc.guidance.plant import PathSample, SingleAxisPlant, angle_of
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings
from tests.support.thread_loop import BELIEVED, PERIOD

TRUE = replace(BELIEVED, stiffness=1e-5, damping=2e-6)
RELEASE = (angle_of(0.2), -0.1)
TARGETS = (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)
"""Targets (rad) of `config/step_demo.yaml`."""
STEP = 20.0
SETTLED_S, OVERSHOOT = 8.7, 0.008
_BAND = 0.05
_PENALTY = 20.0


@dataclass(frozen=True, slots=True)
class Flown:
    """Mean R I^2 (W) over the steps, longest settling time (s), and largest overshoot as a fraction."""

    power: float
    settling: float
    overshoot: float


@dataclass(frozen=True, slots=True)
class Criterion:
    """True body, and the limits of settling time (s) and overshoot (fraction) that a baseline must keep."""

    true: SingleAxisPlant = TRUE
    settling: float = SETTLED_S
    overshoot: float = OVERSHOOT

    def loss(self, flown: Flown) -> float:
        """Return the power (mW) plus a penalty for exceeded limits."""
        slow, over = max(0.0, flown.settling - self.settling), max(0.0, flown.overshoot - self.overshoot)
        return 1e3 * flown.power + _PENALTY * (slow + 100.0 * over)


def fly(controller: AngleController, true: SingleAxisPlant = TRUE) -> Flown:
    """Simulate the steps of a true body with perfect measurements."""
    (angle, rate), current, energy = RELEASE, 0.0, 0.0
    slowest = furthest = 0.0
    for q2 in TARGETS:
        wanted = PathSample(angle_of(q2), 0.0, 0.0)
        size = wanted.angle - angle
        errors = []
        for _ in range(round(STEP / PERIOD)):
            errors.append((wanted.angle - angle) / size)
            made = controller.command(wanted, angle, rate)
            middle = rate + 0.5 * PERIOD * true.acceleration(angle, rate, current)
            there = angle + 0.5 * PERIOD * rate
            angle, rate = angle + PERIOD * middle, rate + PERIOD * true.acceleration(there, middle, current)
            energy += PERIOD * true.resistance * current * current
            current = made.current
        outside = np.flatnonzero(np.abs(errors) > _BAND)
        slowest = max(slowest, PERIOD * (outside[-1] + 1) if outside.size else 0.0)
        furthest = max(furthest, -min(errors))
    return Flown(energy / (STEP * len(TARGETS)), slowest, furthest)


def pid(x: Sequence[float]) -> AngleController:
    """Return the PID controller with the four variables `x`."""
    proportional, integral, derivative = np.exp(x[:3]).tolist()
    weight = 1.0 / (1.0 + math.exp(-x[3]))
    return PidController(BELIEVED, PERIOD, PidSettings(proportional, integral, derivative), weight)


def adaptive(x: Sequence[float]) -> AngleController:
    """Return the adaptive controller with the three variables `x`."""
    return AdaptiveController(BELIEVED, PERIOD, AdaptiveSettings(*np.exp(x).tolist()))


STARTS: dict[str, tuple[Callable[[Sequence[float]], AngleController], tuple[tuple[float, ...], ...]]] = {
    "pid": (pid, ((math.log(1.7), math.log(0.44), math.log(2.3), -2.0), (-0.7, -2.4, 0.0, -1.5))),
    "adaptive": (adaptive, ((0.0, 2.3, -0.58), (-0.5, 1.0, -0.5), (0.5, 3.0, -0.7))),
}


def tune(
    name: str, criterion: Criterion, progress: Callable[[str], object] = lambda _: None
) -> tuple[tuple[float, ...], Flown]:
    """Return the best variables of a baseline controller, and the results of the steps with them."""
    make, starts = STARTS[name]
    best: tuple[float, tuple[float, ...]] | None = None
    for start in starts:
        found = minimize(
            lambda x: criterion.loss(fly(make(x), criterion.true)),
            start,
            method="Nelder-Mead",
            options={"maxfev": 800, "xatol": 1e-3, "fatol": 1e-3},
        )
        progress(f"{name}: from {start}: loss {found.fun:.3f}\n")
        if best is None or found.fun < best[0]:
            best = float(found.fun), tuple(found.x.tolist())
    assert best is not None
    return best[1], fly(make(best[1]), criterion.true)


def named(name: str, x: Sequence[float]) -> dict[str, float]:
    """Return the gains as a mapping from their names in the configuration."""
    if name == "pid":
        gains = np.exp(x[:3]).tolist()
        weight = 1.0 / (1.0 + math.exp(-x[3]))
        return dict(
            zip(("proportional", "integral", "derivative", "target_weight"), [*gains, weight], strict=True)
        )
    return dict(zip(("bandwidth", "adaptation", "reference_bandwidth"), np.exp(x).tolist(), strict=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Tune and print; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.tune_controllers", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--stiffness", type=float, default=TRUE.stiffness, help="of the thread, N m/rad")
    parser.add_argument("--settling", type=float, default=SETTLED_S, help="s, default %(default)s")
    parser.add_argument("--overshoot", type=float, default=OVERSHOOT, help="a share, default %(default)s")
    options = parser.parse_args(arguments)
    true = replace(TRUE, stiffness=options.stiffness)
    criterion = Criterion(true, options.settling, options.overshoot)
    facts = {}
    for name in STARTS:
        x, flown = tune(name, criterion, sys.stderr.write)
        facts[name] = {
            **named(name, x),
            "power_w": flown.power,
            "settling_s": flown.settling,
            "overshoot": flown.overshoot,
        }
    if options.json:
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        for name, found in facts.items():
            sys.stdout.write(f"{name}: {', '.join(f'{key} {value:.4g}' for key, value in found.items())}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
