"""Fault injection at device level; faults that would have no effect are rejected.

`catalogue` is the table of all faults, and `bench` the hardware that they act on. `schedule` parses and
checks the faults of a flight and puts them on its time line. `host` injects faults into the flight process
itself (workers, wall clock, disk).
"""
