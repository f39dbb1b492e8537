"""Plan a step of a body on a thread with one torque coil, and print its angle and coil current."""

from __future__ import annotations

import numpy as np

from knightcube import SingleAxisPlant, plan_step

plant = SingleAxisPlant(inertia=1.05e-3, torque_constant=2.916e-4, resistance=23.0, current_limit=0.148)
plan = plan_step(plant, start_angle=0.0, end_angle=np.radians(45.0), horizon=15.0)
print(f"status   {plan.status}")
print(f"horizon  {plan.horizon:.2f} s")
print(f"energy   {1e3 * plan.energy:.1f} mJ")
times = np.linspace(0.0, plan.horizon, 6)[:-1]
angle, rate, acceleration = plan.path.motion(times)
current = plant.currents(angle, rate, acceleration)
for row in zip(times, np.degrees(angle), 1e3 * current, strict=True):
    print("{:5.1f} s {:6.2f} deg {:7.2f} mA".format(*row))
