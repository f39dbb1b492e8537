"""Reactions and the transition table agree: every answer of the table can happen."""

from __future__ import annotations

import pytest

from flight.link.modes import Mode
from flight.loop.fdir.facts import FACTS
from flight.loop.modes.table import TRANSITIONS
from flight.loop.tasks.mode_control import SAFING_REACTIONS


@pytest.mark.parametrize("mode", list(Mode))
def test_every_reaction_that_leads_out_of_a_mode_belongs_to_a_fact_watched_in_it(mode: Mode) -> None:
    for reaction, trigger in SAFING_REACTIONS.items():
        if isinstance(TRANSITIONS[mode][trigger], Mode):
            watched = [fact for fact in FACTS if fact.begins.reaction is reaction and mode in fact.modes]
            assert watched, f"nothing in {mode.label} can bring about {reaction.name.lower()}"
