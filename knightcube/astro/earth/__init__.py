"""Models of the Earth's figure, orientation, shadow and magnetic field, of the Sun, and of orbits."""
