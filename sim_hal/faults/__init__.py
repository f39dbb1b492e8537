"""Fault injection at device level; faults that would have no effect are rejected.

`catalogue` lists them, `grammar` parses them, `schedule` checks them and puts them on the `timeline`. `bench`
holds the hardware that they act on; `serial`, `parts`, `circuit`, `imaging` and `machine` implement them.
`host` injects faults into the flight process itself (workers, wall clock, disk).
"""
