"""Tests that each frame source fulfils the contract of hal.interfaces.devices.FrameSource."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hal.interfaces.errors import NotResponding
from tests.hal.cameras.rig import EXPOSURE_NS, Rig

PATIENCE_NS = 400_000_000


def test_nothing_comes_untriggered(rig: Rig) -> None:
    assert rig.source.poll() is None
    assert rig.frame_within(PATIENCE_NS) is None


def test_a_trigger_gives_exactly_one_frame_exposed_after_it(rig: Rig) -> None:
    trigger_ns = rig.clock.now_ns()
    frame = rig.next_frame()
    assert frame.exposure_start_ns >= trigger_ns
    assert frame.exposure_ns == EXPOSURE_NS
    assert frame.exposure_start_ns + EXPOSURE_NS <= frame.arrival_ns <= rig.clock.now_ns()
    assert rig.frame_within(PATIENCE_NS) is None, "one trigger, one frame"


def test_pixels_are_rows_by_columns_and_whole_numbers(rig: Rig) -> None:
    pixels = rig.next_frame().pixels
    assert pixels.shape == rig.shape
    assert pixels.dtype in (np.uint8, np.uint16)
    assert pixels.flags.c_contiguous


def test_sequence_numbers_only_grow(rig: Rig) -> None:
    numbers = [rig.next_frame().sequence for _ in range(6)]
    assert all(later > earlier for earlier, later in itertools.pairwise(numbers))


def test_a_frame_keeps_its_pixels_when_others_follow(rig: Rig) -> None:
    first = rig.next_frame().pixels
    as_it_came = first.copy()
    others = [rig.next_frame().pixels for _ in range(6)]
    assert np.array_equal(first, as_it_came)
    assert not all(np.array_equal(first, other) for other in others)


def test_the_frame_after_a_second_trigger_is_the_seconds(rig: Rig) -> None:
    rig.source.trigger(EXPOSURE_NS)
    rig.wait(EXPOSURE_NS // 4)
    second_ns = rig.clock.now_ns()
    frame = rig.next_frame()
    assert frame.exposure_start_ns >= second_ns
    assert rig.frame_within(PATIENCE_NS) is None


def test_closing_twice_is_safe(rig: Rig) -> None:
    rig.source.trigger(EXPOSURE_NS)
    rig.source.close()
    rig.source.close()


def test_a_camera_that_is_gone_does_not_answer_the_trigger(rig: Rig) -> None:
    if rig.unplug is None:
        pytest.skip("Aravis' Fake camera cannot be unplugged")
    rig.next_frame()
    rig.unplug()
    rig.wait(20_000_000)
    with pytest.raises(NotResponding):
        rig.source.trigger(EXPOSURE_NS)
