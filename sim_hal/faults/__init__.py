"""Fault injection at device level; faults that would have no effect are rejected.

`catalogue` lists all faults by name, `bus_faults` and `sensor_faults` implement them, `bench` holds the
hardware that they act on. `schedule` parses and checks the faults of a flight and puts them on its time line.
`host` injects faults into the flight process itself (workers, wall clock, disk).
"""
