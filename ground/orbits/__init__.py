"""First orbits of the objects that a flight tracked."""
