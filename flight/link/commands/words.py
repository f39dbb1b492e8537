"""Commands in words, by the table: the name, then each field in order; labels stand for states.

`slew 0.2`, `mode hold`, `safe end of pass`, `point sun`. Numbers at the end that are left out are NaN, a text
is all that is left. Units are those of the table.
"""

from __future__ import annotations

import math
from typing import Any

from flight.link.commands.codec import CommandPacker, command_of
from flight.link.commands.definitions import LAYOUTS
from flight.link.commands.errors import CommandError
from flight.link.commands.values import Command
from flight.link.telemetry.form import Field


def command_of_words(text: str) -> Command:
    """Return the command of a line of words.

    Raises CommandError, also for a number that its field does not hold.
    """
    name, *words = text.split() or [""]
    if name not in LAYOUTS:
        raise CommandError(f"{name!r} is no command: {', '.join(LAYOUTS)}")
    packet = LAYOUTS[name].packet
    fields: dict[str, Any] = {}
    for field in packet.fields:
        if field.kind.startswith("S"):
            fields[field.name], words = " ".join(words), []
            continue
        taken, words = words[: field.count], words[field.count :]
        numbers = [_number(field, word) for word in [*taken, *[""] * (field.count - len(taken))]]
        fields[field.name] = numbers if field.count > 1 else numbers[0]
    if words:
        raise CommandError(f"{text}: nothing is to stand behind {packet.fields[-1].name}")
    command = command_of(packet, fields)
    CommandPacker().pack(command, 0)
    return command


def _number(field: Field, word: str) -> float | int:
    for number, label in field.states:
        if word == label:
            return number
    real = field.kind.startswith("f")
    if not word and real:
        return math.nan
    try:
        return float(word) if real else int(word)
    except ValueError:
        labels = ", ".join(label for _, label in field.states)
        raise CommandError(
            f"{field.name} = {word!r}: {f'one of {labels}' if labels else field.meaning}"
        ) from None
