"""Time for which the coils carry current after a fault.

Real-time flights on emulated devices in a separate process are stopped, hung and killed. The benchmark
measures the time from the fault to zero current in the log of the devices, which has a sample every 25 ms.
The guardian must zero the current within 0.5 s.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Annotated

from tests.hal.guardian.campaign import UNGUARDED, Hurt, hurt_in_every_way
from tests.studies.command import Table, command, scratch


@command
def main(rounds: Annotated[int, "of all faults"] = 3) -> int:
    """Print the table. Returns 1 if a coil was driven for more than 0.5 s."""
    found: defaultdict[str, list[Hurt]] = defaultdict(list)
    for _ in range(rounds):
        with scratch() as folder:
            for hurt in hurt_in_every_way(folder).hurts:
                found[hurt.act].append(hurt)
    table = Table()
    for act, hurts in found.items():
        before = max(1e3 * abs(hurt.current) for hurt in hurts)
        zero = max(hurt.zero_after for hurt in hurts)
        back = max((hurt.recovered for hurt in hurts if hurt.recovered is not None), default="-")
        table.add(runs=len(hurts), mA_before=before, zero_after_s=zero, recovered_s=back, act=act)
    guarded = [hurt for act, hurts in found.items() if act not in UNGUARDED for hurt in hurts]
    return int(any(hurt.zero_after > 0.5 for hurt in guarded))
