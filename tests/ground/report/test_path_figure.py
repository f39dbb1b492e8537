"""One planned path is drawn with its attitude, rate and current."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.bodies.testbed.thread import plant_of
from flight.schema import reader as configuration
from flight.schema.testbed import as_testbed
from ground.report import draw_path
from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.vmc import plan

pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")
from matplotlib.image import imread

from ground.report.path_figure import path_figure

CONFIG = Path(__file__).resolve().parents[3] / "config" / "step_demo.yaml"


def test_a_path_is_drawn_from_its_start_to_its_target_within_the_limit(tmp_path: Path) -> None:
    plant = plant_of(as_testbed(configuration.load(CONFIG)))
    made = plan(plant, -0.3, 0.0, -0.2, 0.0, 10.0)
    attitude, rate, current = path_figure(made, plant).axes
    q2 = np.asarray(attitude.get_lines()[0].get_ydata())
    assert (q2[0], q2[-1]) == pytest.approx((-0.3, -0.2), abs=1e-9)
    line = rate.get_lines()[0]
    values, spans = np.asarray(line.get_ydata()) / 1e3, np.diff(np.asarray(line.get_xdata()))
    assert 0.5 * (values[1:] + values[:-1]) @ spans == pytest.approx(
        2.0 * (np.arcsin(-0.2) - np.arcsin(-0.3)), abs=1e-4
    )
    drawn = np.abs(np.asarray(current.get_lines()[0].get_ydata()))
    assert drawn.max() == pytest.approx(made.peak_current, rel=0.02)
    assert drawn.max() <= 1.001 * plant.current_limit
    file = tmp_path / "path.png"
    draw_path(made, plant, file)
    assert imread(file).std() > 0.01
    with pytest.raises(UsageError, match="no pictures can be written there"):
        draw_path(made, plant, tmp_path)
