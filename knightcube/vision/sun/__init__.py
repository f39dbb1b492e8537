"""The Sun's direction from a camera's frame, and coarsely from the currents of solar strings.

`direction` finds it in a frame, `strings` in currents; `cameras` orders the cameras for reading,
`several_cameras` reads them, and lets the strings stand in where none has the Sun. `field_and_strings` gives
the attitude by the magnetic field and the strings. Eclipses are predicted by `knightcube.astro.earth.shadow`.
"""
