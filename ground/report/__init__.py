"""Report of a run from its packets: performance measures of the thesis, tables and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ground.report.summary import summarise
from ground.report.text import format_report
from ground.telemetry import Run
from knightcube.errors import UsageError, reason_of

if TYPE_CHECKING:
    from ground.identification.fit import PlantFit
    from ground.identification.record import Record
    from ground.passes import OrbitPrediction, Station
    from knightcube.gnc.guidance.plant import SingleAxisPlant
    from knightcube.gnc.guidance.slew_plan import OrderedSlew, SlewOrder
    from knightcube.gnc.guidance.vmc import StepPlan

__all__ = ["draw", "draw_both", "draw_day", "draw_fit", "draw_path", "draw_slew", "drawing"]
__all__ += ["format_report", "summarise"]


def draw(run: Run, folder: Path) -> list[Path]:
    """Draw the pictures of a run into `folder` and return the files.

    Raises UsageError if matplotlib is not installed or the folder cannot be written.
    """
    with drawing(folder):
        from ground.report.figures import draw_figures  # noqa: PLC0415

        folder.mkdir(parents=True, exist_ok=True)
        return draw_figures(run, folder)


def draw_both(first: Run, second: Run, folder: Path) -> Path:
    """Draw two runs into one picture in `folder` and return the file. Raises UsageError."""
    with drawing(folder):
        from ground.report.figures import draw_comparison  # noqa: PLC0415

        folder.mkdir(parents=True, exist_ok=True)
        return draw_comparison(first, second, folder)


def draw_path(plan: StepPlan, plant: SingleAxisPlant, file: Path) -> None:
    """Draw one planned path as a PNG. Raises UsageError."""
    with drawing(file):
        from ground.report.figures import path_figure, save  # noqa: PLC0415

        save(path_figure(plan, plant), file)


def draw_day(
    prediction: OrbitPrediction, stations: Sequence[Station], targets: Sequence[tuple[float, str]], file: Path
) -> None:
    """Draw passes, eclipses and targets (pairs of start, s, and name) as a PNG. Raises UsageError."""
    with drawing(file):
        from ground.report.figures import day_figure, save  # noqa: PLC0415

        save(day_figure(prediction, stations, targets), file)


def draw_slew(made: OrderedSlew, order: SlewOrder, file: Path) -> None:
    """Draw one planned slew in orbit as a PNG. Raises UsageError."""
    with drawing(file):
        from ground.report.figures import save, slew_figure  # noqa: PLC0415

        save(slew_figure(made, order), file)


def draw_fit(record: Record, found: PlantFit, file: Path) -> None:
    """Draw the measured and fitted motion of an identification flight as a PNG. Raises UsageError."""
    with drawing(file):
        from ground.report.figures import fit_figure, save  # noqa: PLC0415

        save(fit_figure(record, found), file)


@contextmanager
def drawing(place: Path) -> Iterator[None]:
    """Raise UsageError with a message of one line if matplotlib is missing or a file cannot be written."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        raise UsageError("pictures need matplotlib: pip install '.[plots]'") from error
    except OSError as error:
        raise UsageError(f"{place}: the picture cannot be written: {reason_of(error)}") from error
