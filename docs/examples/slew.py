"""Plan a slew of a CubeSat with torque coils from nadir to Sun, with an exclusion cone of the Moon."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from knightcube import Goal, PointingTarget, plan_slew

ELEMENTS = (
    "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05",
    "2 99999  97.4640 337.4170 0011973 295.7805  64.3547 15.24067411    09",
)

slew = plan_slew(
    inertia=np.diag([1.10e-3, 1.05e-3, 0.99e-3]),
    dipole_limit=[0.1, 0.1, 0.1],
    heat=[50.0, 50.0, 50.0],
    elements=ELEMENTS,
    time=datetime(2026, 3, 20, 12, 10, tzinfo=UTC),
    start=PointingTarget(Goal.NADIR),
    goal=PointingTarget(Goal.SUN),
    duration=600.0,
    cones={"moon": np.radians(15.0)},
)
plan, path = slew.plan, slew.plan.path
print(f"status        {plan.status}")
print(f"duration      {plan.horizon:.0f} s")
print(f"energy        {1e3 * plan.energy:.2f} mJ")
print(f"peak dipole   {100.0 * plan.peak:.0f} % of the limit")
print(f"peak rate     {np.degrees(np.linalg.norm(path.rate, axis=1).max()):.2f} deg/s")
print(f"Moon          {np.degrees(plan.clearance[0]):.0f} deg outside its cone")
for k in range(0, len(path.times), 12):
    print(
        f"{path.times[k]:6.0f} s  q {path.quaternion[k].round(3)}  m {(1e3 * path.dipole[k]).round(1)} mA m^2"
    )
