"""Recovers a VN-100 that was lost in flight, one step at each poll; nothing here waits.

A unit that lost power or was reset runs on the settings in its flash, perhaps at another baud rate; one that
was unplugged may return in any of these states. Without readings the line is observed: packets show that the
baud rate is right; bytes without packets that it may be wrong, and then others are tried, ours every second
time. At the right baud rate the unit is set up again, one question at a time.
"""

from __future__ import annotations

from collections.abc import Sequence

from hal.drivers.vn100.ascii import Sentence
from hal.drivers.vn100.set_up import PASSING_ERRORS, Dialogue, Question, set_up
from hal.drivers.vn100.settings import Vn100Settings
from hal.interfaces.errors import DeviceError, Refused
from hal.interfaces.wires import SerialPort

# In order of likelihood, the factory's setting first.
BAUD_RATES = (115200, 230400, 921600, 460800, 57600, 38400, 19200, 9600)

_PATIENCE_NS = 150_000_000  # without a reading, before recovery begins
_LISTEN_NS = 90_000_000  # at one baud rate: three packets of 40 Hz
_REFUSED_WAIT_NS = 1_000_000_000


class Recovery:
    """The dialogue with a lost unit.

    Attributes:
        completed: how often a unit was set up again.
        refusal: the unit's last refusal, empty without one.
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
        """Note that the unit has restarted: even with readings, its settings are those in its flash."""
        # The first sample after a recovery shows the restart that was handled already.
        self._was_reset = not self._is_fresh

    def advance(
        self, now_ns: int, readings: int, sentences: Sequence[Sentence], packets: int, received: int
    ) -> None:
        """Advance by one poll with its number of readings, its sentences, and all packets and bytes so far.

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
        """Listen at this baud rate; begin the dialogue if it is right or nothing comes; else try another."""
        assert self._listening_since_ns is not None
        if packets > self._packets:
            self._begin(now_ns)
        elif now_ns - self._listening_since_ns >= _LISTEN_NS:
            if received == self._bytes:
                # Silence: its output may be switched off.
                self._begin(now_ns)
            else:
                self._change_rate()
                self._listen(now_ns, packets, received)

    def _change_rate(self) -> None:
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
            # Answered at the old baud rate.
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
                self._accept(answer, now_ns)
                return
            complaint = question.complaint(sentence)
            if complaint is not None:
                if complaint[0] not in PASSING_ERRORS:
                    raise Refused("vn100", f"{question.text()} was answered with {complaint[1]}")
                again = True
        if again:
            self._repeat(question, now_ns)

    def _accept(self, answer: tuple[str, ...], now_ns: int) -> None:
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
            # Readings should arrive now; if not, recovery begins again after the same time.
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
        """Return to the state before the dialogue; the next step listens again."""
        self._dialogue = None
        self._listening_since_ns = None
        self._has_written = False

    def _ask(self, question: Question, now_ns: int) -> None:
        self._question, self._asked_ns = question, now_ns
        self._has_written = self._has_written or question.command == "WRG"
        try:
            self._port.send(question.message())
        except DeviceError:
            self._give_up()
            raise
