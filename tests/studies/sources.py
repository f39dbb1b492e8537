"""Tables of the three sources beside the same quantities here.

Without a table the command lists every table and figure of the sources that has data, with the command that
reproduces it here. The tables that this command measures are printed as Markdown for the results pages.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.quaternion import conjugate, from_rotation_vector, multiply, to_rotation_vector
from knightcube.reference.corner_streaks import DETECTOR_NAMES
from knightcube.reference.star_identification import (
    DEFAULT,
    Propose,
    match_images,
    propose_angles,
    propose_families,
    propose_pyramids,
    search,
)
from knightcube.reference.star_tables import KnownSky
from knightcube.vision.startracker.index.build import default_index
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns import lost_in_space, rso_orbits
from tests.studies.campaigns.rso import EXPOSURE, draw_sky, look
from tests.studies.campaigns.rso_orbits import corner_rate, mean_errors, rate_error
from tests.studies.campaigns.streaks import THESIS_BIAS, measured_bias
from tests.studies.command import Seed, command
from tests.support.scenes import BRIGHTEST, FIELD
from tests.support.star_lists import ListKind, draw

Rows = list[list[str]]
"""Cells of a table; the first row is the header."""
_NO_FOLDER = Path()
_ARCSECONDS = float(np.degrees(3600.0))

INDEX = (
    ("Sease, Table 3.1; Fig. 3.7 to 3.10", "campaigns streaks-thesis --runs 2 --seed 12; source_pictures"),
    ("Sease, Tables 4.1 and 4.2", "sources tables-4-1-and-4-2"),
    ("Sease, Tables 4.3 and 4.4", "sources table-4-4"),
    ("Sease, Tables 5.1 and 5.2", "(values of config/step_demo.yaml; tests/hal/coils)"),
    ("Sease, Table 5.3, powers", "campaigns controllers"),
    ("Sease, Fig. 2.1, 3.1 to 3.5, 4.2 to 4.4, 5.4 to 5.8", "source_pictures"),
    ("Michalski, Table 1", "(rows of the results pages)"),
    ("Michalski, centroids and solvers, AIM", "bench solve_methods; sources image-matching"),
    ("Michalski, identification", "campaigns lost-in-space; sources cosine-limits"),
    ("Meller et al., section 3.2.1", "(pytest tests/knightcube/reference/test_horizon.py)"),
    ("Meller et al., section 4", "(campaigns coverage, at commit 5e5e847b)"),
)
"""Tables and figures of the source documents, with the study that makes each."""


def one_frame_tables(runs: int, seed: int) -> Rows:
    """Return Tables 4.1 and 4.2: rate and axis from one frame with an object of magnitude 4."""
    rows = [["scene", "estimator", "rates", "rate error, %, thesis; here", "axis error, deg, thesis; here"]]
    camera = StarCameraModel(field_of_view=FIELD)
    for tracked, table, printed in (
        (True, "4.1, object tracked", (0.9, 0.65)),
        (False, "4.2, slew", (0.67, 0.2)),
    ):
        errors: dict[str, list[list[float] | None]] = {"harris": [], "likelihood": []}
        for run in range(runs):
            generator = np.random.default_rng((seed, run, int(tracked)))
            sky = draw_sky(camera, generator, tracked)
            pixels = sky.frame(camera, rso_orbits.TABLE_MAGNITUDE, generator)
            report, _ = look(pixels, camera, sky.rate)
            errors["harris"].append(rate_error(corner_rate(pixels, camera, sky.rate), sky.rate))
            found = None if report is None else report.rotation / EXPOSURE
            errors["likelihood"].append(rate_error(found, sky.rate))
        for name, own in errors.items():
            mean = mean_errors(own)
            values = [f"{p:g}; {_number(mean[key])}" for p, key in zip(printed, ERRORS, strict=True)]
            rows.append([table, f"`{name}`", f"{mean['rates']} of {runs}", *values])
    return rows


ERRORS = ("magnitude_percent", "axis_deg")


def table_4_4(runs: int, seed: int) -> Rows:
    """Return Table 4.4: correct, overlapping and false detections of ten orbits, and the rate errors."""
    cases = [
        case
        for case in rso_orbits.cases(runs, seed)
        if case.parameters["magnitude"] == rso_orbits.TABLE_MAGNITUDE
    ]
    facts = rso_orbits.summarise([rso_orbits.run(case) for case in cases], _NO_FOLDER).facts
    skies = [facts["skies"][name] for name in (f"brightest {BRIGHTEST}", "whole")]
    rows = [["correct / overlapping / false", "thesis", "7,000 brightest stars", "all stars to V 8.5"]]
    names = ("centre of rotation", "magnitude of rotation", "combined indicator")
    for number, (name, printed) in enumerate(zip(names, rso_orbits.THESIS, strict=True)):
        own = [_counts(sky["strict"][number]) for sky in skies]
        rows.append([f"{name}, 2.5 sigma", _counts(printed), *own])
    rows.append(["default search of this software", "", *(_counts(sky["judge"]) for sky in skies)])
    for name in rso_orbits.ESTIMATORS:
        for key, quantity, printed_limit in (
            ("magnitude_percent", "rate error, %", "< 1"),
            ("axis_deg", "axis error, deg", "0.4"),
        ):
            values = [_number(sky[name][key]) for sky in skies]
            rows.append([f"mean {quantity}, `{name}`", printed_limit, *values])
    return [*rows, ["opportunities", "14", *([str(sum(facts["opportunities"]))] * 2)]]


def end_biases(runs: int, seed: int) -> Rows:
    """Return the inward bias of streak ends in the thesis's frames; `streaks-thesis` removes this bias."""
    rows = [["detector", "bias in use, px", "measured, px"]]
    for name in DETECTOR_NAMES:
        rows.append([f"`{name}`", f"{THESIS_BIAS[name]:.2f}", f"{measured_bias(name, runs, seed):.3f}"])
    return rows


def image_matching_errors(runs: int, seed: int) -> Rows:
    """Return the attitude errors of AIM relative to the q-method, by prior error and number of steps."""
    steps = (1, 2, 3, 4)
    head = [
        "field, deg",
        "prior error, deg",
        "q-method, arcsec",
        *(f"{n} step{'s' * (n > 1)}" for n in steps),
    ]
    rows, stars = [head], default_index().stars
    for field_deg in (12.0, 20.0):
        for prior_deg in (0.01, 0.1, 1.0, 5.0):
            off: dict[int, list[FloatArray]] = {number: [] for number in (0, *steps)}
            for run in range(runs):
                rng = np.random.default_rng((seed, run, round(field_deg)))
                drawn = draw(ListKind(field_deg, noise_px=0.1, known_deg=0.0), stars, rng)
                axis = rng.standard_normal(3)
                turn = np.radians(prior_deg) * axis / np.linalg.norm(axis)
                field, prior = drawn.field(), multiply(from_rotation_vector(turn), drawn.attitude)
                matched = field.direction, stars.direction[drawn.star], field.sigma
                for number, turns in off.items():
                    optimal = SOLVERS["davenport"](*matched)
                    fix = match_images(*matched, prior, number) if number else optimal
                    turns.append(to_rotation_vector(multiply(fix.quaternion, conjugate(drawn.attitude))))
            rms = [_ARCSECONDS * float(np.sqrt(np.mean(np.square(each)))) for each in off.values()]
            rows.append([f"{field_deg:g}", f"{prior_deg:g}", *(_number(each) for each in rms)])
    return rows


FIELD_DEG = 15.0
"""Field of view (deg) of the lists of `cosine_limits`, as in the campaign `lost-in-space`."""
_WITH_ANGLES: dict[str, Propose] = {
    "angle": propose_angles,
    "pyramid": propose_pyramids,
    "voting": propose_families,
}


def cosine_limits(runs: int, seed: int) -> Rows:
    """Return the results on the same lists with limits of angles and of their cosines (eq. 31)."""
    rows = [["method", "lists", "right; wrong, angle", "right; wrong, eq. 31", "ms, angle", "ms, eq. 31"]]
    half = float(np.tan(np.radians(0.5 * FIELD_DEG)))
    sky = KnownSky(default_index(), (half, half))
    _ = sky.pairs, sky.tree
    faintest = float(sky.stars.magnitude[-1])
    nominal = ListKind(FIELD_DEG, 0.3, 2, faintest, magnitude_error=0.2, lost=0.1, known_deg=0.0)
    for label, kind in (("", nominal), (", 2 px of noise", replace(nominal, noise_px=2.0))):
        drawn = [draw(kind, sky.index.stars, np.random.default_rng((seed, run))) for run in range(runs)]
        for name, propose in _WITH_ANGLES.items():
            counts, spent = [], []
            for by_cosine in (False, True):
                settings = replace(DEFAULT, cosine_limits=by_cosine)
                begun = time.process_time()
                answers = [search(each.field(), sky, propose, settings) for each in drawn]
                spent.append(f"{1e3 * (time.process_time() - begun) / runs:.1f}")
                verdicts = [lost_in_space.verdict(a, d) for a, d in zip(answers, drawn, strict=True)]
                counts.append(f"{verdicts.count('right')}; {verdicts.count('wrong')}")
            rows.append([f"`{name}`{label}", str(runs), *counts, *spent])
    return rows


@dataclass(frozen=True, slots=True)
class Table:
    """A table that this study measures, with its function and the default number of runs."""

    measure: Callable[[int, int], Rows]
    runs: int


TABLES = {
    "tables-4-1-and-4-2": Table(one_frame_tables, 20),
    "table-4-4": Table(table_4_4, 1),
    "end-biases": Table(end_biases, 16),
    "image-matching": Table(image_matching_errors, 100),
    "cosine-limits": Table(cosine_limits, 100),
}


def markdown(rows: Rows) -> str:
    """Return a table as Markdown."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "".join(f"| {' | '.join(line)} |\n".replace("|  |", "| |") for line in lines)


@command
def main(
    table: Annotated[str | None, "the table to measure (default: list all)", sorted(TABLES)] = None,
    *,
    runs: Annotated[int | None, "frames or lists of a cell, or times ten orbits"] = None,
    seed: Seed = 11,
) -> int:
    """Print a table of a source, or the list of all."""
    if table is None:
        sys.stdout.write(markdown([["table or figure", "study"], *([*row] for row in INDEX)]))
        return 0
    chosen = TABLES[table]
    runs = runs or chosen.runs
    sys.stdout.write(markdown(chosen.measure(runs, seed)))
    today = datetime.now().astimezone().date()
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    sys.stdout.write(f"\n`sources {table} --runs {runs} --seed {seed}`, {today}, {commit}\n")
    return 0


def _counts(values: Sequence[int]) -> str:
    return " / ".join(str(value) for value in values)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


if __name__ == "__main__":
    raise SystemExit(main())
