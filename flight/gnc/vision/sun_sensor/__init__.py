"""The Sun: its direction from any camera's frame, and coarsely from the currents of solar strings.

`direction` finds it in a frame, `strings` in currents; `cameras` says which camera is to be read first.
When the Earth hides it is for `flight.gnc.earth.shadow` to say.
"""
