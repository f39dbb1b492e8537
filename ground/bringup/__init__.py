"""The first bench session with new hardware (`knightcube bringup`).

`devices` finds the devices on their buses and lines, `session` measures step by step, `diagnosis` names the
faults from the measurements, and `picture` draws them.
"""
