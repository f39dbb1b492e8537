"""The Sun's direction from a camera's frame, and coarsely from the currents of solar strings.

`direction` finds it in a frame, `strings` in currents; `cameras` orders the cameras for reading. Eclipses are
predicted by `flight.gnc.earth.shadow`.
"""
