"""Campaign `orbit-slews`: slews by coils alone in the simulated world with all disturbances.

A 3U turns by 30 to 180 deg in 600 to 1,200 s, the KnightCube in 300 s, from rest to rest among the stars, by
three laws on the same seeds. `share` multiplies the worst cases of drag, sunlight and the turn of the
principal axes, which no law here knows; all other disturbances are whole. `path` plans with `plan_slew` and
holds the path by gains of the pointing table along it. `eigen-axis` follows the turn about one axis in
fifth-order time by the pointing law with its preview; `projected` by proportional and derivative torque whose
part along the field is lost. The laws know attitude and rate with noise, field and place as predicted from
one GPS fix, and the residual dipole but for a tenth. The coils pause a tenth of each second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.gnc.control.three_axes.pointing import PointingLaw
from flight.gnc.control.three_axes.pointing_table import PointingTable, PointingWeights, table_along
from flight.gnc.earth.ephemeris import Ephemeris
from flight.gnc.errors import PlanningError
from flight.gnc.guidance.three_axes.attitude_law import References, references
from flight.gnc.guidance.three_axes.slew_ends import Whole
from flight.gnc.guidance.three_axes.slew_model import SlewCraft
from flight.gnc.guidance.three_axes.slew_plan import SlewPlan, SlewStatus, plan_slew
from flight.gnc.guidance.three_axes.slew_sky import along
from flight.gnc.guidance.three_axes.slew_task import SlewTask
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from sim_hal.worlds.free_body.section import Disturbances, TipOff
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.free_flight import SECOND, WATTS, FreeFlight

CELLS = (
    ("path", 0.0),
    ("eigen-axis", 0.0),
    ("projected", 0.0),
    ("path", 0.1),
    ("eigen-axis", 0.1),
    ("projected", 0.1),
    ("path", 0.3),
)
"""Law and share."""
HORIZON = {"knightcube": (300.0, 300.0), "cubesat_3u": (600.0, 1200.0)}
"""s."""
WANTED = {"knightcube": 2.0, "cubesat_3u": 0.5}
"""deg at the end, of issue 16."""
CYCLE, PAUSE = 1.0, 0.1
"""s."""
KNOT, TAIL, LEAD = 5.0, 300.0, 2.0
"""s: the step of the gains, how far they look past the end, and the fix's time before the begin."""
RESERVE = 0.8
"""Of the limit that is planned with: the rest is the tracker's, and for the pauses."""
ATTITUDE_SIGMA, RATE_SIGMA, DIPOLE_SIGMA = 1e-4, 2e-5, 1e-4
"""rad, rad/s and A m^2 of an axis: what the filter leaves."""
WEIGHTS = {
    "knightcube": PointingWeights(turn=np.radians(1.0), rate=1.0, dipole=2e-3),
    "cubesat_3u": PointingWeights(turn=np.radians(1.0), rate=1.0, dipole=5e-3),
}
BANDWIDTH = 12.0
"""Of the projected law: rad a horizon."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` slews of each craft, in the two orbits by turns, by each law and share."""
    return [
        Case(
            f"{craft}/{run}/{law}/{share}",
            (seed, run),
            {"craft": craft, "orbit": ("sso", "iss")[run % 2], "law": law, "share": share},
        )
        for run in range(runs)
        for craft in HORIZON
        for law, share in CELLS
    ]


def run(case: Case) -> Result:
    """Fly the case."""
    slew = _Slew(case)
    facts: Result = {**case.parameters, "angle": slew.angle, "horizon": slew.horizon}
    try:
        plan = plan_slew(slew.task)
    except PlanningError as error:
        return {**facts, "refused": str(error)}
    if plan.status is not SlewStatus.OPTIMAL:
        return {**facts, "refused": "stretched"}
    command = {"path": slew.path, "eigen-axis": slew.eigen_axis, "projected": slew.projected}[
        case.parameters["law"]
    ]
    slew.fly(command(plan))
    off = np.degrees(angle_between(slew.flight.motion.quaternion, slew.target))
    heat = WATTS[case.parameters["craft"]] * slew.flight.square
    return {**facts, "off": float(off), "heat": heat, "optimum": plan.energy}


Command = Callable[[float, FloatArray, FloatArray, FloatArray], FloatArray]
"""Gives a dipole (3,) at a time for an attitude (4,), a rate (3,) and the field (3,), body axes."""


class _Slew:
    """One craft and its slew."""

    def __init__(self, case: Case) -> None:
        self._craft = case.parameters["craft"]
        seed = case.seed[0] * 100_003 + case.seed[1]
        rng = np.random.default_rng([*case.seed, 16])
        start = normalise(rng.normal(size=4))
        self.angle = float(rng.uniform(30.0, 180.0))
        self.turn = np.radians(self.angle) * normalise(rng.normal(size=3))
        self.horizon = float(rng.uniform(*HORIZON[self._craft]))
        qx, qy, qz, qw = start.tolist()
        tip_off = TipOff(rate=(0.0, 0.0, 0.0), attitude=(qx, qy, qz, qw))
        share = case.parameters["share"]
        noises = Disturbances(drag=share, solar_pressure=share, principal_turn_deg=3.0 * share)
        self.flight = FreeFlight(self._craft, seed, case.parameters["orbit"], tip_off, noises)
        self.flight.advance(0)
        self._rng = rng
        self.start, self.target = start, multiply(from_rotation_vector(self.turn), start)
        self._ahead = self.flight.ephemeris(self.horizon + TAIL + 60.0)
        known = self.flight.body.orbit_truth().residual_dipole + DIPOLE_SIGMA * rng.normal(size=3)
        self._residual: FloatArray = known
        limit = np.full(3, self.flight.limit)
        model = SlewCraft(self.flight.inertia, RESERVE * limit, np.full(3, WATTS[self._craft]), known)
        end = Whole(self.target, np.zeros(3))
        self.task = SlewTask(
            model, along(self._ahead, 0.0), start, np.zeros(3), lambda _: end, self.horizon, self.horizon
        )

    def path(self, plan: SlewPlan) -> Command:
        """Return the planned dipoles with the gains along the path."""
        flown = plan.path.references
        table = self._table(flown(np.arange(0.0, self.horizon + TAIL, KNOT)))

        def command(time: float, q: FloatArray, rate: FloatArray, field: FloatArray) -> FloatArray:
            wanted = flown(np.array([time]))
            turn = to_rotation_vector(multiply(q, conjugate(wanted.quaternion[0])))
            missed = rate - attitude_matrix(from_rotation_vector(turn)) @ wanted.rate[0]
            error = np.concatenate([turn, missed - np.cross(turn, wanted.rate[0])])
            pull = _gain(table, time) @ error
            back = pull - field * (float(field @ pull) / float(field @ field))
            # The planned dipole belongs to the planned attitude.
            planned = plan.path.dipoles(np.array([min(time + 0.5 * CYCLE, self.horizon)]))[0]
            return np.asarray(planned - back)

        return command

    def eigen_axis(self, plan: SlewPlan) -> Command:
        """Return the pointing law about the turn around one axis."""
        wanted = references(self._about_one_axis, self._ahead, np.arange(2.0, self.horizon + TAIL, KNOT))
        law = PointingLaw(self._table(wanted), self.flight.limit)
        nothing = np.zeros(0)

        def command(time: float, q: FloatArray, rate: FloatArray, field: FloatArray) -> FloatArray:
            return law.command(time, q, rate, field, self._residual, nothing).dipole

        return command

    def projected(self, plan: SlewPlan) -> Command:
        """Return the part of a proportional and derivative torque that the coils can make."""
        inertia, pace = self.flight.inertia, BANDWIDTH / self.horizon
        wanted = references(self._about_one_axis, self._ahead, np.arange(2.0, self.horizon + TAIL, 1.0))

        def command(time: float, q: FloatArray, rate: FloatArray, field: FloatArray) -> FloatArray:
            now = wanted.at(time)
            turn = to_rotation_vector(multiply(q, conjugate(now.quaternion)))
            pull = pace**2 * turn + 2.0 * pace * (rate - now.rate)
            torque = inertia @ (now.acceleration - pull) + np.cross(rate, inertia @ rate)
            return np.asarray(np.cross(field, torque) / float(field @ field) - self._residual)

        return command

    def fly(self, command: Command) -> None:
        """Fly until the end of the slew."""
        flight = self.flight
        for k in range(round(self.horizon / CYCLE)):
            time = k * CYCLE
            flight.act(np.zeros(3))
            flight.advance(round((time + PAUSE) * SECOND))
            q = flight.attitude(ATTITUDE_SIGMA)
            rate = flight.motion.rate + RATE_SIGMA * self._rng.normal(size=3)
            field = attitude_matrix(q) @ self._ahead.field_at(np.array([time + PAUSE]))[0]
            dipole = command(time + PAUSE, q, rate, field) * (CYCLE / (CYCLE - PAUSE))
            largest = float(np.abs(dipole).max())
            flight.act(dipole * min(1.0, flight.limit / largest))
            flight.advance(round((time + CYCLE) * SECOND))

    def _about_one_axis(self, _: Ephemeris, times: FloatArray) -> FloatArray:
        s = np.clip(times / self.horizon, 0.0, 1.0)[:, None]
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        return multiply(from_rotation_vector(share * self.turn), self.start)

    def _table(self, wanted: References) -> PointingTable:
        field, position = self._ahead.field_at(wanted.times), self._ahead.position_at(wanted.times)
        return table_along(wanted, field, position, self.flight.inertia, WEIGHTS[self._craft])


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return errors at the end and heat by craft and law."""
    facts: dict[str, Any] = {}
    heads = ("runs", "refused", "median", "worst", "within", "heat", "worst")
    lines = [f"{'craft, law, share':28}" + "".join(f"{head:>9}" for head in heads)]
    for craft in HORIZON:
        for law, share in CELLS:
            mine = [r for r in results if (r["craft"], r["law"], r["share"]) == (craft, law, share)]
            flown = [r for r in mine if "off" in r]
            if not flown:
                continue
            off = np.array([r["off"] for r in flown])
            heat = np.array([r["heat"] / r["optimum"] for r in flown])
            found = {
                "runs": len(mine),
                "refused": len(mine) - len(flown),
                "median": float(np.median(off)),
                "worst": float(off.max()),
                "within": float(np.mean(off <= WANTED[craft])),
                "heat": float(np.median(heat)),
                "worst_heat": float(heat.max()),
            }
            facts[f"{craft}/{law}/{share}"] = found
            row = "".join(f"{value:9.3g}" for value in found.values())
            lines.append(f"{f'{craft}, {law}, {share}':28}{row}")
    lines.append("deg off the target at the end, the share within that wanted, heat over that planned")
    return Summary("\n".join(lines) + "\n", facts)


ORBIT_SLEWS = Campaign(
    "orbit-slews", "slews in three axes by coils alone, all disturbances", cases, run, summarise, 40
)


def _gain(table: PointingTable, time: float) -> FloatArray:
    """Return the gain (3, 6) at a time, on a line between the table's."""
    k, share = table.path.place(time)
    return np.asarray((1.0 - share) * table.gain[k] + share * table.gain[min(k + 1, len(table.gain) - 1)])
