"""What one control cycle's coil command costs in lock-step: driver, registers, bridges, coils.

python -m tests.studies.bench.coils
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from tests.hal.coils.rig import Rig

BUDGET_US = 60.0


def microseconds(action: Callable[[], object], repetitions: int = 5000, rounds: int = 5) -> float:
    """Return the time of one call, the best of several rounds: the code's cost, not the machine's load."""
    best = float("inf")
    for _ in range(rounds):
        begin = time.perf_counter()
        for _ in range(repetitions):
            action()
        best = min(best, time.perf_counter() - begin)
    return best / repetitions * 1e6


def main() -> int:
    """Print the costs; 1 when a command is over its budget."""
    rig = Rig(uncertainty=3.5e-3)
    rig.coils.start()
    currents = np.array([0.1, -0.05, 0.02])
    command = microseconds(lambda: rig.coils.command(currents))
    rows = {
        "command() + registers + circuit": command,
        "of it, the chip's 24-byte write and the circuit": microseconds(
            lambda: rig.bus.write_i2c_block_data(0x40, 0x06, [0, 0, 0, 4] * 6)
        ),
        "of it, the circuit": microseconds(lambda: rig.wire.circuit.update(0xFFFF)),
        "state()": microseconds(rig.coils.state),
    }
    for name, cost in rows.items():
        sys.stdout.write(f"{cost:7.1f} us  {name}\n")
    sys.stdout.write(f"budget of a command: {BUDGET_US:.0f} us\n")
    return 0 if command <= BUDGET_US else 1


if __name__ == "__main__":
    sys.exit(main())
