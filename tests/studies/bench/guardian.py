"""Time for which the coils carry current after a fault: `python -m tests.studies.bench guardian [ROUNDS]`.

Real-time flights on emulated devices in a separate process are stopped, hung and killed. The benchmark
measures the time from the fault to zero current in the log of the devices, which has a sample every 25 ms.
The guardian must zero the current within 0.5 s.
"""

from __future__ import annotations

import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from tests.hal.guardian.campaign import UNGUARDED, Hurt, hurt_in_every_way


def main(arguments: Sequence[str]) -> int:
    """Print the table. Returns 1 if a coil was driven for more than 0.5 s."""
    rounds = int(arguments[0]) if arguments else 3
    found: defaultdict[str, list[Hurt]] = defaultdict(list)
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            for hurt in hurt_in_every_way(Path(folder)).hurts:
                found[hurt.act].append(hurt)
    sys.stdout.write(f"{'act':28}{'runs':>5}{'mA before':>11}{'zero after, s':>15}{'recovered, s':>14}\n")
    for act, hurts in found.items():
        before = max(1e3 * abs(hurt.current) for hurt in hurts)
        zero = max(hurt.zero_after for hurt in hurts)
        back = [hurt.recovered for hurt in hurts if hurt.recovered is not None]
        recovered = f"{max(back):14.3f}" if back else f"{'-':>14}"
        sys.stdout.write(f"{act:28}{len(hurts):5}{before:11.1f}{zero:15.3f}{recovered}\n")
    return int(
        any(hurt.zero_after > 0.5 for act, hurts in found.items() if act != UNGUARDED for hurt in hurts)
    )
