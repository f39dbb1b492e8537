"""Fault injection at device level, which rejects faults that would have no effect.

The module `catalogue` describes the simulated hardware that faults affect, and is the table of all faults.
The module `schedule` parses, checks and schedules the faults of a flight. The module `host` injects faults
into the flight process itself (workers, wall clock, disk).
"""
