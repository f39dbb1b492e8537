"""Tests of the times at which the coil currents are known."""

from __future__ import annotations

import numpy as np

from flight.loop.navigation import STOOD_NS, CoilKnowledge, CurrentValidity
from hal.guardian import SILENCE_NS
from hal.interfaces.devices import CoilState

MS = 1_000_000
OBEYS = CoilState(np.zeros(3), np.zeros(3), 0, False, 0, False, 0, "")
REFUSES = OBEYS._replace(error="pca9685 at 0x40: does not keep the values written to its output registers")


def test_the_currents_of_a_chip_that_obeys_are_known() -> None:
    knowledge = CoilKnowledge()
    looks = [knowledge.look(OBEYS, 1000 * MS + 25 * MS * cycle) for cycle in range(4)]
    assert looks == [CurrentValidity(True, True, -1, None)] * 4


def test_the_currents_of_a_chip_that_refuses_are_unknown_since_it_was_last_read_back() -> None:
    knowledge = CoilKnowledge()
    knowledge.look(OBEYS, 1000 * MS)
    first, second = (knowledge.look(REFUSES, now * MS) for now in (1025, 1050))
    assert first == CurrentValidity(False, False, -1, 425 * MS)
    assert second == CurrentValidity(False, False, -1, None)
    again, then = (knowledge.look(OBEYS, now * MS) for now in (1075, 1100))
    assert again == CurrentValidity(True, False, 1075 * MS, None), "unknown before the chip obeyed again"
    assert then == CurrentValidity(True, True, 1075 * MS, None)


def test_a_suspected_coil_may_carry_any_current_since_before_the_suspicion() -> None:
    knowledge = CoilKnowledge()
    knowledge.look(OBEYS, 1000 * MS)
    begun, on = (knowledge.look(OBEYS, now * MS, suspected=True) for now in (1025, 1050))
    assert begun == CurrentValidity(False, True, -1, 225 * MS)
    assert on == CurrentValidity(False, True, -1, None)
    over = knowledge.look(OBEYS, 1075 * MS)
    assert over == CurrentValidity(True, True, 1075 * MS, None), "unknown until the suspicion was over"


def test_the_currents_during_a_stall_of_the_loop_are_unknown() -> None:
    knowledge = CoilKnowledge()
    knowledge.look(OBEYS, 1000 * MS)
    assert knowledge.look(OBEYS, 1150 * MS).since_last_look, "no guardian has acted yet"
    stood = knowledge.look(OBEYS, 1450 * MS)
    assert stood == CurrentValidity(True, False, 1450 * MS, 1150 * MS)
    assert knowledge.look(OBEYS, 1475 * MS) == CurrentValidity(True, True, 1450 * MS, None)


def test_no_guardian_acts_in_a_gap_that_the_loop_does_not_detect() -> None:
    """The guardian never acts in a gap of the heartbeats that is too short for the loop to detect.

    The gap can be nearly two cycles longer than the interval between the loop's checks.
    """
    assert STOOD_NS + 2 * 25 * MS < SILENCE_NS
