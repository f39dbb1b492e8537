"""Campaign `streaked`: attitudes from frames of streaks, of cameras that differ from the model.

The frames have the imperfections of the campaign `resting`, and streaks of 10, 20 and 40 px in the centre.
The rotation about the boresight is at most that across it. Additional cameras have rolling shutters of 0, 20
and 30 us per row, with known and unknown line time.
"""

from __future__ import annotations

from ground.campaigns.runner import Campaign, Case, Result
from tests.studies.campaigns.imperfections import IMPERFECTIONS, Imperfection
from tests.studies.campaigns.resting import look_at, summarise

STREAKS = (10.0, 20.0, 40.0)
"""Lengths of the streaks (px)."""
ROLLING = (0.0, 20e-6, 30e-6)
"""Line times (s)."""
_ABOUT = 1.0
SHUTTERS = {
    f"rolling {1e6 * line_time:.0f} us, {'stated' if stated else 'unstated'}": Imperfection(
        line_time=line_time, known={"line_time": line_time if stated else None}
    )
    for line_time in ROLLING
    for stated in (True, False)
}
ROWS = SHUTTERS | IMPERFECTIONS


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` frames of each camera and length."""
    return [
        Case(f"{name} {length:g} {run}", (seed, cell, run), {"row": name, "trail": length})
        for cell, (name, length) in enumerate((name, length) for name in ROWS for length in STREAKS)
        for run in range(runs)
    ]


def run(case: Case) -> Result:
    """Solve one frame of streaks, and evaluate its attitude."""
    return look_at(case, ROWS[case.parameters["row"]], _ABOUT)


STREAKED = Campaign(
    "streaked",
    "attitudes from frames of streaks: claims of cameras like and unlike the model, of rolling shutters too",
    cases,
    run,
    summarise,
    10,
)
