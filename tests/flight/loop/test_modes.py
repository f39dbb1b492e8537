"""Tests that the transition table is complete, that each mode can be reached, and SAFE from every mode."""

from __future__ import annotations

from itertools import product

import pytest

from flight.link.events import Mode, Reaction
from flight.loop.facts import FACTS
from flight.loop.modes import (
    COMMANDS,
    SAFING,
    SAFING_REACTIONS,
    STARTS,
    TRANSITIONS,
    HoldTimer,
    ModeChange,
    ModeMachine,
    Row,
    Table,
    Trigger,
    TriggerAnswer,
    check,
    modes_moved_by,
)
from knightcube.errors import KnightCubeError


@pytest.mark.parametrize("mode", list(Mode))
def test_every_reaction_that_leads_out_of_a_mode_belongs_to_a_fact_watched_in_it(mode: Mode) -> None:
    for reaction, trigger in SAFING_REACTIONS.items():
        if isinstance(TRANSITIONS[mode][trigger], Mode):
            watched = [fact for fact in FACTS if fact.begins.reaction is reaction and mode in fact.modes]
            assert watched, f"nothing in {mode.label} can bring about {reaction.name.lower()}"


UNSAFE = [mode for mode in Mode if mode is not Mode.SAFE]
Broken = dict[Mode, dict[Trigger, Mode | TriggerAnswer]]


def copied() -> Broken:
    return {mode: dict(row) for mode, row in TRANSITIONS.items()}


def in_mode(mode: Mode, table: Table = TRANSITIONS) -> ModeMachine:
    machine = ModeMachine(table=table)
    machine.mode = mode
    return machine


def test_the_transition_table_is_valid() -> None:
    check(TRANSITIONS)


@pytest.mark.parametrize(("mode", "trigger"), list(product(Mode, SAFING)))
def test_every_trigger_of_safe_leads_to_safe_from_every_mode(mode: Mode, trigger: Trigger) -> None:
    machine = in_mode(mode)
    machine.fire(trigger, 7)
    assert machine.mode is Mode.SAFE


@pytest.mark.parametrize(("mode", "trigger"), list(product(Mode, Trigger)))
def test_every_trigger_has_an_answer_in_every_mode_and_the_machine_follows_it(
    mode: Mode, trigger: Trigger
) -> None:
    machine = in_mode(mode)
    answer = machine.answer(trigger)
    change = machine.fire(trigger, 42)
    if isinstance(answer, TriggerAnswer):
        assert change is None
        assert (machine.mode, machine.since_ns) == (mode, 0)
    else:
        assert change == ModeChange(mode, answer, trigger)
        assert (machine.mode, machine.since_ns) == (answer, 42)


def test_only_commands_are_ever_refused_and_only_while_booting() -> None:
    refused = {
        (mode, trigger)
        for mode, row in TRANSITIONS.items()
        for trigger in row
        if row[trigger] is TriggerAnswer.REFUSE
    }
    assert refused == {(Mode.BOOT, trigger) for trigger in set(COMMANDS.values()) - {Trigger.COMMAND_SAFE}}


def test_nothing_but_a_command_or_a_charged_battery_leads_out_of_safe() -> None:
    leads_out = {t for t, to in TRANSITIONS[Mode.SAFE].items() if isinstance(to, Mode)}
    charged = {Trigger.CHARGED_ACQUIRE, Trigger.CHARGED_HOLD, Trigger.CHARGED_DEMO}
    assert leads_out == set(COMMANDS.values()) - {Trigger.COMMAND_SAFE} | charged
    for mode in set(Mode) - {Mode.SAFE}:
        assert not any(isinstance(TRANSITIONS[mode][trigger], Mode) for trigger in charged)


def test_boot_is_for_the_start_only() -> None:
    machine = ModeMachine()
    assert machine.mode is Mode.BOOT
    for mode, trigger in STARTS.items():
        assert in_mode(Mode.BOOT).fire(trigger, 0) == ModeChange(Mode.BOOT, mode, trigger)
        for elsewhere in set(Mode) - {Mode.BOOT}:
            assert in_mode(elsewhere).fire(trigger, 0) is None


@pytest.mark.parametrize(("mode", "trigger"), list(product(Mode, Trigger)))
def test_a_table_without_an_entry_is_refused_by_name(mode: Mode, trigger: Trigger) -> None:
    table = copied()
    del table[mode][trigger]
    with pytest.raises(KnightCubeError, match=f"{mode.label} has no entry for '{trigger.value}'"):
        ModeMachine(table=table)


def test_a_table_without_a_row_is_refused() -> None:
    table = copied()
    del table[Mode.SLEW]
    with pytest.raises(KnightCubeError, match="slew has no row"):
        check(table)


@pytest.mark.parametrize(("mode", "trigger"), list(product(UNSAFE, SAFING)))
def test_a_table_that_keeps_a_mode_from_safe_is_refused(mode: Mode, trigger: Trigger) -> None:
    for wrong in (TriggerAnswer.STAY, TriggerAnswer.REFUSE, Mode.HOLD):
        table = copied()
        table[mode][trigger] = wrong
        with pytest.raises(KnightCubeError, match=f"does not change {mode.label} to safe"):
            check(table)


def test_a_dead_end_is_refused() -> None:
    table = copied()
    row: Row = {t: (TriggerAnswer.STAY if isinstance(to, Mode) else to) for t, to in table[Mode.SAFE].items()}
    with pytest.raises(KnightCubeError, match="safe is a dead end"):
        check({**table, Mode.SAFE: row})


def test_a_mode_that_nothing_leads_to_is_refused() -> None:
    def without_slew(row: Row) -> Row:
        return {t: (TriggerAnswer.STAY if to is Mode.SLEW else to) for t, to in row.items()}

    with pytest.raises(KnightCubeError, match="slew cannot be reached"):
        check({mode: without_slew(row) for mode, row in TRANSITIONS.items()})


def test_a_way_back_to_boot_is_refused() -> None:
    table = copied()
    table[Mode.HOLD][Trigger.ARRIVED] = Mode.BOOT
    with pytest.raises(KnightCubeError, match="hold leads back to boot"):
        check(table)


def test_labels_lead_back_to_their_modes() -> None:
    assert [Mode.named(mode.label) for mode in Mode] == list(Mode)
    with pytest.raises(ValueError, match="'fly' is not a mode: use boot, safe"):
        Mode.named("fly")


@pytest.mark.parametrize(
    ("mode", "changes"),
    [
        (Mode.HOLD, {}),
        (Mode.SLEW, {Trigger.REACT_HOLD: Mode.HOLD, Trigger.ARRIVED: Mode.HOLD}),
        (Mode.TESTBED_DEMO, {Trigger.COMMAND_DEMO: TriggerAnswer.STAY}),
        (
            Mode.DETUMBLE,
            {
                Trigger.COMMAND_SUN: TriggerAnswer.STAY,
                Trigger.COMMAND_POINT: TriggerAnswer.STAY,
                Trigger.COMMAND_DETUMBLE: TriggerAnswer.STAY,
                Trigger.REACT_DETUMBLE: TriggerAnswer.STAY,
                Trigger.DETUMBLED: Mode.HOLD,
                Trigger.SLOWED: Mode.ACQUIRE,
            },
        ),
        (
            Mode.ACQUIRE,
            {
                Trigger.KNOWN_SUN: Mode.SUN,
                Trigger.KNOWN_POINT: Mode.POINT,
                Trigger.COMMAND_SUN: TriggerAnswer.STAY,
                Trigger.COMMAND_POINT: TriggerAnswer.STAY,
            },
        ),
        (Mode.SUN, {Trigger.LOST: Mode.ACQUIRE, Trigger.COMMAND_SUN: TriggerAnswer.STAY}),
        (Mode.POINT, {Trigger.LOST: Mode.ACQUIRE}),
    ],
)
def test_a_steered_mode_follows_commands_and_reactions_with_its_exceptions(mode: Mode, changes: Row) -> None:
    usual: Row = {
        Trigger.COMMAND_SAFE: Mode.SAFE,
        Trigger.COMMAND_DETUMBLE: Mode.DETUMBLE,
        Trigger.COMMAND_HOLD: Mode.HOLD,
        Trigger.COMMAND_SLEW: Mode.SLEW,
        Trigger.COMMAND_DEMO: Mode.TESTBED_DEMO,
        Trigger.COMMAND_SUN: Mode.SUN,
        Trigger.COMMAND_POINT: Mode.POINT,
        Trigger.REACT_SAFE: Mode.SAFE,
        Trigger.REACT_DETUMBLE: Mode.DETUMBLE,
    }
    expected = {trigger: TriggerAnswer.STAY for trigger in Trigger} | dict(usual) | dict(changes)
    assert dict(TRANSITIONS[mode]) == expected


def test_a_condition_counts_when_it_has_held_for_its_time_without_a_gap() -> None:
    timer = HoldTimer(2.0)
    assert not timer.update(True, 5)
    assert not timer.update(True, 2_000_000_004)
    assert timer.update(True, 2_000_000_005)
    assert not timer.update(False, 2_000_000_006)
    assert not timer.update(True, 2_000_000_007)
    timer.require(1.0)
    assert not timer.update(True, 3_000_000_006)
    assert timer.update(True, 3_000_000_007)
    timer.reset()
    assert not timer.update(True, 3_000_000_008)


def test_a_reaction_without_a_mode_change_has_an_effect_in_every_mode() -> None:
    assert modes_moved_by(Reaction.NOTE) == frozenset(Mode)
    assert modes_moved_by(Reaction.HOLD) == {Mode.SLEW}
    assert modes_moved_by(Reaction.SAFE) == frozenset(Mode) - {Mode.SAFE}
    assert modes_moved_by(Reaction.DETUMBLE) == frozenset(Mode) - {Mode.BOOT, Mode.SAFE, Mode.DETUMBLE}
