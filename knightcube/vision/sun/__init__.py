"""The Sun's direction from a camera's frame, and coarsely from the currents of solar strings.

`direction` finds the Sun in a frame (`disc`: the rim and its circle) and `solar_cells` computes it from
currents. `several_cameras` orders the cameras by the coarse Sun, reads them, and uses the coarse direction if
no camera shows the Sun. `solar_cells` also gives the attitude from the magnetic field and the strings.
`knightcube.astro.earth.shadow` predicts eclipses.
"""
