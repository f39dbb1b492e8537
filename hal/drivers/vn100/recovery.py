"""Gets a VN-100 that was lost in flight to speak again, a little at each poll: nothing here waits.

A unit that lost its power or was reset runs on what its flash holds, perhaps at another speed; one that was
unplugged may have come back as any of these. While no reading comes the line is listened to: packets tell
that the speed is right, bytes without packets that it may not be, and then others are tried, the own one
every second time. At the right speed the unit is set up anew, one question at a time.
"""

from __future__ import annotations

from collections.abc import Sequence

from hal.drivers.vn100.ascii import Sentence
from hal.drivers.vn100.set_up import PASSING_ERRORS, Dialogue, Question, set_up
from hal.drivers.vn100.settings import Vn100Settings
from hal.interfaces.errors import DeviceError, Refused
from hal.interfaces.wires import SerialPort

# By how likely they are: the factory's first.
BAUD_RATES = (115200, 230400, 921600, 460800, 57600, 38400, 19200, 9600)

_PATIENCE_NS = 150_000_000  # without a reading, until something is done
_LISTEN_NS = 90_000_000  # at one speed: three packets of 40 Hz
_REFUSED_WAIT_NS = 1_000_000_000


class Recovery:
    """The dialogue with a lost unit.

    Attributes:
        completed: how often a unit was set up anew.
        refusal: what the unit said no to, empty when nothing.
    """

    def __init__(self, port: SerialPort, settings: Vn100Settings) -> None:
        self.completed = 0
        self.refusal = ""
        self._port = port
        self._settings = settings
        self._own_rate = port.baud_rate
        self._others = [rate for rate in BAUD_RATES if rate != port.baud_rate]
        self._other = 0
        self._reading_ns: int | None = None
        self._listening_since_ns: int | None = None
        self._packets = self._bytes = 0
        self._dialogue: Dialogue | None = None
        self._question: Question | None = None
        self._asked_ns = 0
        self._tries = 0
        self._wait_until_ns = 0
        self._was_reset = False
        self._is_fresh = False
        self._has_written = False

    def reset(self) -> None:
        """Be told that the unit has started anew: readings or not, its settings are the saved ones."""
        # The first sample after a unit was set up anew tells of the start that was found already.
        self._was_reset = not self._is_fresh

    def advance(
        self, now_ns: int, readings: int, sentences: Sequence[Sentence], packets: int, received: int
    ) -> None:
        """Take what a poll brought: readings, sentences; and all packets and bytes until now.

        Raises NotResponding when the port is gone.
        """
        if self._reading_ns is None:
            self._reading_ns = now_ns
        if readings:
            self._is_fresh = False
        if readings and self._port.baud_rate == self._own_rate and not self._was_reset:
            self._reading_ns = now_ns
            if not self._has_written:
                self._dialogue = None
                self._listening_since_ns = None
                return
        patient = now_ns - self._reading_ns <= _PATIENCE_NS and not (self._was_reset or self._has_written)
        if patient or now_ns < self._wait_until_ns:
            return
        if self._listening_since_ns is None:
            self._listen(now_ns, packets, received)
        try:
            if self._dialogue is not None:
                self._converse(now_ns, sentences)
            else:
                self._seek(now_ns, packets, received)
        except Refused as error:
            self.refusal = error.message
            self._give_up()
            self._wait_until_ns = now_ns + _REFUSED_WAIT_NS

    def _listen(self, now_ns: int, packets: int, received: int) -> None:
        self._listening_since_ns = now_ns
        self._packets, self._bytes = packets, received
        self._dialogue = None

    def _seek(self, now_ns: int, packets: int, received: int) -> None:
        """Listen at this speed; begin to speak when it is right or when nothing comes; else try another."""
        assert self._listening_since_ns is not None
        if packets > self._packets:
            self._begin(now_ns)
        elif now_ns - self._listening_since_ns >= _LISTEN_NS:
            if received == self._bytes:
                # Silence: the unit may have been told to be silent.
                self._begin(now_ns)
            else:
                self._take_next_rate()
                self._listen(now_ns, packets, received)

    def _take_next_rate(self) -> None:
        if self._port.baud_rate == self._own_rate:
            self._port.set_baud_rate(self._others[self._other])
            self._other = (self._other + 1) % len(self._others)
        else:
            self._port.set_baud_rate(self._own_rate)

    def _begin(self, now_ns: int) -> None:
        self._dialogue = self._whole_dialogue()
        self._tries = 0
        self._ask(next(self._dialogue), now_ns)

    def _whole_dialogue(self) -> Dialogue:
        if self._port.baud_rate != self._own_rate:
            # Answered at the old speed.
            yield Question("WRG", (5, self._own_rate))
            self._port.set_baud_rate(self._own_rate)
        yield from set_up(self._settings)

    def _converse(self, now_ns: int, sentences: Sequence[Sentence]) -> None:
        question = self._question
        assert question is not None
        assert self._dialogue is not None
        again = now_ns - self._asked_ns >= self._settings.response_timeout_ns
        for sentence in sentences:
            answer = question.answer(sentence)
            if answer is not None:
                self._take(answer, now_ns)
                return
            complaint = question.complaint(sentence)
            if complaint is not None:
                if complaint[0] not in PASSING_ERRORS:
                    raise Refused("vn100", f"{question.text()} was answered with {complaint[1]}")
                again = True
        if again:
            self._repeat(question, now_ns)

    def _take(self, answer: tuple[str, ...], now_ns: int) -> None:
        assert self._dialogue is not None
        self._tries = 0
        try:
            self._ask(self._dialogue.send(answer), now_ns)
        except StopIteration:
            self._give_up()
            self._was_reset = False
            self._is_fresh = True
            self.completed += 1
            self.refusal = ""
            # Readings should come now; if they do not, it begins anew after the same patience.
            self._reading_ns = now_ns

    def _repeat(self, question: Question, now_ns: int) -> None:
        self._tries += 1
        if self._tries < self._settings.tries:
            self._ask(question, now_ns)
            return
        self._give_up()
        if self._port.baud_rate != self._own_rate:
            self._port.set_baud_rate(self._own_rate)

    def _give_up(self) -> None:
        """Be where it was before the dialogue; whoever listens again begins a new one."""
        self._dialogue = None
        self._listening_since_ns = None
        self._has_written = False

    def _ask(self, question: Question, now_ns: int) -> None:
        self._question, self._asked_ns = question, now_ns
        self._has_written = self._has_written or question.command == "WRG"
        try:
            self._port.send(question.words())
        except DeviceError:
            self._give_up()
            raise
