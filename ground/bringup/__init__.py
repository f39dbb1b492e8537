"""The first bench session with new hardware (`knightcube bringup`).

`bench` finds and opens the devices on their buses and lines, `session` measures step by step, and `diagnosis`
names the faults from the measurements.
"""
