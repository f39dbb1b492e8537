"""Tests that plots of artificial runs have the recorded curves, areas, colours, scales and labels."""

from __future__ import annotations

import pytest

pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")

from ground.report import figures
from ground.report.panels import RunSignals
from tests.ground.report.drawn_examples import PICTURES, recorded, rounded
from tests.ground.report.drawn_figure import described, unlike
from tests.support.packed_run import packed_run


def unlike_record(*names: str) -> list[str]:
    """Return the differences between the plots and their recorded descriptions."""
    return [
        f"{name}{line}"
        for name in names
        for line in unlike(recorded(name), rounded(described(PICTURES[name]())))
    ]


def test_the_picture_of_the_overview_of_a_run_is_as_recorded() -> None:
    assert unlike_record("overview") == []


def test_the_picture_of_the_overview_without_the_truth_is_as_recorded() -> None:
    assert unlike_record("overview without the truth") == []


def test_the_picture_of_the_rate_is_as_recorded() -> None:
    assert unlike_record("rate", "rate without the truth") == []


def test_the_picture_of_the_planned_paths_and_cycle_times_is_as_recorded() -> None:
    assert unlike_record("paths", "cycle times") == []


def test_the_picture_of_attitude_current_and_power_is_as_recorded() -> None:
    assert unlike_record("attitude", "current", "power") == []


def test_the_picture_of_the_field_of_the_cage_is_as_recorded() -> None:
    assert unlike_record("cage") == []


def test_the_picture_of_two_runs_beside_each_other_is_as_recorded() -> None:
    assert unlike_record("comparison") == []


def test_the_picture_of_a_planned_path_is_as_recorded() -> None:
    assert unlike_record("path") == []


def test_the_picture_of_an_identification_is_as_recorded() -> None:
    assert unlike_record("fit") == []


def test_the_picture_of_the_detumbling_is_as_recorded() -> None:
    assert unlike_record("spin", "spin without the truth") == []


def test_the_picture_of_the_attitude_knowledge_is_as_recorded() -> None:
    assert unlike_record("knowledge") == []


def test_the_picture_of_the_pointing_is_as_recorded() -> None:
    assert unlike_record("pointing") == []


def test_the_picture_of_the_pointing_without_the_truth_is_as_recorded() -> None:
    assert unlike_record("pointing without the truth") == []


def test_the_picture_of_the_ground_track_and_objects_is_as_recorded() -> None:
    assert unlike_record("track", "objects") == []


def test_the_picture_of_a_planned_slew_is_as_recorded() -> None:
    assert unlike_record("slew") == []


def test_the_picture_of_a_planned_slew_far_from_its_limits_is_as_recorded() -> None:
    assert unlike_record("slew far from its limits") == []


def test_a_run_without_packets_has_no_picture() -> None:
    signals = RunSignals(packed_run())
    pictures = (
        figures._attitude,
        figures._current,
        figures._power,
        figures._paths,
        figures._cycle_times,
        figures._rate,
        figures._overview,
        figures.cage_figure,
        figures.spin_figure,
        figures.knowledge_figure,
        figures.pointing_figure,
        figures.track_figure,
        figures.objects_figure,
    )
    assert [picture(signals) for picture in pictures] == [None] * len(pictures)
