"""Time for which the coils carry current after a fault.

Real-time flights on emulated devices in a separate process are stopped, hung and killed. The benchmark
measures the time from the fault to zero current in the log of the devices; this log has a sample every 25 ms.
The guardian must zero the current within 0.5 s.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Annotated

from tests.hal.guardian.campaign import UNGUARDED, ProcessFault, disturb_in_every_way
from tests.studies.command import Table, command, scratch


@command
def main(rounds: Annotated[int, "of all faults"] = 3) -> int:
    """Print the table. Returns 1 if a coil was driven for more than 0.5 s."""
    found: defaultdict[str, list[ProcessFault]] = defaultdict(list)
    for _ in range(rounds):
        with scratch() as folder:
            for fault in disturb_in_every_way(folder).faults:
                found[fault.act].append(fault)
    table = Table()
    for act, faults in found.items():
        before = max(1e3 * abs(fault.current) for fault in faults)
        zero = max(fault.zero_after for fault in faults)
        back = max((fault.recovered for fault in faults if fault.recovered is not None), default="-")
        table.add(runs=len(faults), mA_before=before, zero_after_s=zero, recovered_s=back, act=act)
    guarded = [fault for act, faults in found.items() if act not in UNGUARDED for fault in faults]
    return int(any(fault.zero_after > 0.5 for fault in guarded))
