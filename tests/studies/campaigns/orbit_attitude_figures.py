"""Figures, table and picture of the campaign `orbit-attitude`, from the notes of its runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from tests.studies.campaigns.campaign import Result
from tests.studies.campaigns.consistency import band

SETTLED = 300.0
"""s after which the sunlit figures count."""
WHENS = {"both": "Sun and nadir in view", "sunlit": "all sunlight", "eclipse": "end of eclipse"}


def variant_facts(results: Sequence[Result]) -> dict[str, Any]:
    """Return the figures of one variant's runs."""
    parts = [_parts(np.array(result["notes"])) for result in results]
    low, high = band(len(results) * 6)
    # Instants that all runs have, counted from the end: eclipses end together.
    shortest = min(len(result["notes"]) for result in results)
    nees = np.array([np.array(result["notes"])[-shortest:, 8] for result in results])
    # Only instants at which every run has an attitude: the band is for their number.
    whole = np.all(np.isfinite(nees), axis=0)
    whole[: round(SETTLED / 10.0)] = False
    settled = np.mean(nees[:, whole], axis=0) / 6.0
    kinds = sorted({kind for result in results for kind in result["nis"]})
    return {
        "runs": len(results),
        **{name: _figures(parts, name) for name in WHENS},
        "nees_band": [low, high],
        "share_in_band": float(np.mean((settled >= low) & (settled <= high))),
        "nees_mean": float(np.mean(settled)),
        "nis": {
            kind: float(np.divide(*np.sum([r["nis"].get(kind, [0.0, 0.0]) for r in results], axis=0)))
            for kind in kinds
        },
        "refused": {kind: sum(r["refused"].get(kind, 0) for r in results) for kind in kinds},
        "starts": max(result["starts"] for result in results),
        "never": sum(result["starts"] == 0 for result in results),
    }


def _parts(notes: FloatArray) -> dict[str, float]:
    """Return rms errors of an axis, deg, what was said of them, and NEES.

    "both" with Sun and nadir in use, "sunlit" with or without, "eclipse" in its last minute.
    """
    seconds, sunlit = notes[:, 0], notes[:, 1] > 0.5
    error, sigma, nees = notes[:, 2:5], notes[:, 5:8], notes[:, 8] / 6.0
    day = sunlit & (seconds >= SETTLED)
    end = ~sunlit & (seconds > seconds[-1] - 60.0)
    found = {}
    both = day & (notes[:, 9] > 0.5)
    for name, when in (("both", both), ("sunlit", day), ("eclipse", end)):
        found[name] = _rms(error[when])
        found[f"{name} said"] = _rms(sigma[when])
        found[f"{name} NEES"] = float(np.nanmean(nees[when])) if np.any(np.isfinite(nees[when])) else np.nan
    return found


def _figures(parts: Sequence[dict[str, float]], name: str) -> dict[str, float | None]:
    """Return over the runs: rms, the worst run's, the median of what was said, and the mean NEES."""
    rms = np.array([part[name] for part in parts])
    known = rms[np.isfinite(rms)]
    if not known.size:
        return {"rms": None, "worst": None, "said": None, "nees": None}
    return {
        "rms": float(np.sqrt(np.mean(known**2))),
        "worst": float(np.max(known)),
        "said": float(np.sqrt(np.nanmean([part[f"{name} said"] ** 2 for part in parts]))),
        "nees": float(np.nanmean([part[f"{name} NEES"] for part in parts])),
    }


def _rms(values: FloatArray) -> float:
    """Return the root mean square of an axis, of rows (n, 3)."""
    return float(np.sqrt(np.nanmean(values**2))) if np.any(np.isfinite(values)) else float("nan")


def line_of(variant: str, facts: dict[str, Any]) -> str:
    """Return a variant's row of the table."""
    cells = ""
    for name in WHENS:
        found = facts[name]
        if found["rms"] is None:
            cells += f"{'-':>30}"
        else:
            cells += f"{found['rms']:9.4f}{found['worst']:8.4f}{found['said']:8.4f}{found['nees']:5.2f}"
    return f"{variant:17}{cells}{100 * facts['share_in_band']:8.0f} %"


def draw(results: Sequence[Result], path: Path) -> Path:
    """Draw the error of one orbit within three sigma, eclipse shaded."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    notes = np.array(results[0]["notes"])
    minutes = notes[:, 0] / 60.0
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    for axis, (panel, name) in enumerate(zip(panels, ("forward", "right", "down"), strict=True)):
        bound = 3.0 * notes[:, 5 + axis]
        panel.fill_between(
            minutes, -bound, bound, color="#56B4E9", alpha=0.35, linewidth=0.0, label="3 sigma"
        )
        panel.plot(minutes, notes[:, 2 + axis], color="#0072B2", linewidth=1.0, label="error")
        panel.fill_between(
            minutes,
            -1.0,
            1.0,
            where=notes[:, 1] < 0.5,
            color="0.5",
            alpha=0.2,
            linewidth=0.0,
            label="eclipse",
        )
        panel.set_ylim(-0.5, 0.5)
        panel.set_ylabel(f"{name}, deg")
    panels[0].legend(loc="upper left", ncols=3, fontsize="small")
    panels[-1].set_xlabel("minutes since sunrise")
    figure.suptitle("Attitude error of the filter over one orbit: Sun, nadir, magnetometer, gyros")
    figure.savefig(path, dpi=110)
    return path
