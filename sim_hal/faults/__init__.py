"""Fault injection at device level, which rejects faults that would have no effect.

The module `catalogue` is the table of all faults, and `bench` describes the simulated hardware that faults
affect. The module `schedule` parses, checks and schedules the faults of a flight. The module `host` injects
faults into the flight process itself (workers, wall clock, disk).
"""
