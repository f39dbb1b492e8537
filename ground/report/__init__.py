"""The report of a run: the thesis's performance figures, tables, pictures. Reads packets only."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ground.report.summary import summarise
from ground.report.text import format_report
from ground.telemetry.reader import Run
from knightcube.errors import UsageError

if TYPE_CHECKING:
    from ground.identification.fit import Fit
    from ground.identification.record import Record
    from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant
    from knightcube.gnc.guidance.one_axis.vmc import StepPlan
    from knightcube.gnc.guidance.three_axes.slew_plan import OrderedSlew, SlewOrder

__all__ = ["draw", "draw_both", "draw_fit", "draw_path", "draw_slew", "format_report", "summarise"]


def draw(run: Run, folder: Path) -> list[Path]:
    """Draw the run's pictures into `folder`; returns the files.

    Raises UsageError when matplotlib is not installed or the folder cannot be written.
    """
    with _drawing(folder):
        from ground.report.figures import draw_figures  # noqa: PLC0415

        folder.mkdir(parents=True, exist_ok=True)
        return draw_figures(run, folder)


def draw_both(first: Run, second: Run, folder: Path) -> Path:
    """Draw two runs over each other into `folder`; returns the file. Raises UsageError as `draw`."""
    with _drawing(folder):
        from ground.report.figures import draw_comparison  # noqa: PLC0415

        folder.mkdir(parents=True, exist_ok=True)
        return draw_comparison(first, second, folder)


def draw_path(plan: StepPlan, plant: SingleAxisPlant, file: Path) -> None:
    """Draw one planned path as a PNG.

    Raises UsageError when matplotlib is not installed or the file cannot be written.
    """
    with _drawing(file):
        from ground.report.path_figure import save_path  # noqa: PLC0415

        save_path(plan, plant, file)


def draw_slew(made: OrderedSlew, order: SlewOrder, file: Path) -> None:
    """Draw one planned slew in orbit as a PNG.

    Raises UsageError when matplotlib is not installed or the file cannot be written.
    """
    with _drawing(file):
        from ground.report.slew_figure import save_slew  # noqa: PLC0415

        save_slew(made, order, file)


def draw_fit(record: Record, found: Fit, file: Path) -> None:
    """Draw an identification's measured and predicted motion as a PNG.

    Raises UsageError when matplotlib is not installed or the file cannot be written.
    """
    with _drawing(file):
        from ground.identification.picture import save_fit  # noqa: PLC0415

        save_fit(record, found, file)


@contextmanager
def _drawing(place: Path) -> Iterator[None]:
    """Turn the lack of matplotlib, or of a place to write, into one clear line."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        raise UsageError("pictures need matplotlib: pip install '.[plots]'") from error
    except OSError as error:
        raise UsageError(f"{place}: no pictures can be written there: {error.strerror or error}") from error
