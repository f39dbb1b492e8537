"""Faults as data: what can break, how it is written down, when it breaks, and how it is mended again.

`catalogue` lists every fault, `grammar` reads them, `timeline` does things at instants of the simulation.
`bench` is what they are done to: `serial`, `parts`, `circuit`, `imaging` and `machine` know how. What breaks
in the flight process itself (workers, wall clock, disk) is `host`'s.
"""
