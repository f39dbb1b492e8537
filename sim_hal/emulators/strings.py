"""The solar strings of a world with an orbit, as voltages at their converters' inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hal.drivers.ads1115 import StringWiring
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.ads1115 import EmulatedAds1115
from sim_hal.worlds import sun
from sim_hal.worlds.solar_strings import SolarStringsModel
from sim_hal.worlds.surroundings import OrbitingWorld

_UNIX_EPOCH = 2_440_587.5
_FRESH_NS = 20_000_000


class EmulatedStrings:
    """The strings and the converters that measure them.

    Attributes:
        parts: the converters.
        dead: strings (n,) that give no current. frozen: whether all stay as they are now.
        gain: of all amplifiers over the sound one.
    """

    def __init__(
        self,
        world: OrbitingWorld,
        model: SolarStringsModel,
        wirings: Sequence[StringWiring],
        now_ns: Callable[[], int],
        generator: np.random.Generator,
    ) -> None:
        self.dead = np.zeros(len(wirings), dtype=bool)
        self.frozen = False
        self.gain = 1.0
        self._world, self._model, self._now_ns, self._generator = world, model, now_ns, generator
        self._strings = {(w.address, w.channel): (i, w.volt_per_ampere) for i, w in enumerate(wirings)}
        self._currents: FloatArray = np.zeros(len(wirings))
        self._measured_ns = -_FRESH_NS
        self.parts = tuple(
            EmulatedAds1115(address, now_ns, self._input(address))
            for address in sorted({wiring.address for wiring in wirings})
        )

    def _input(self, address: int) -> Callable[[int], float]:
        def volts(channel: int) -> float:
            index, volt_per_ampere = self._strings.get((address, channel), (None, 0.0))
            return 0.0 if index is None else volt_per_ampere * float(self._now()[index])

        return volts

    def _now(self) -> FloatArray:
        """Return the currents (n,) A as the amplifiers give them; within 20 ms they are measured once."""
        now_ns = self._now_ns()
        if not self.frozen and now_ns - self._measured_ns >= _FRESH_NS:
            self._measured_ns = now_ns
            self._currents = self._light(now_ns)
        return np.where(self.dead, 0.0, self.gain * self._currents)

    def _light(self, now_ns: int) -> FloatArray:
        body = quaternion.attitude_matrix(self._world.motion(now_ns).quaternion)
        around = self._world.surroundings()
        date = _UNIX_EPOCH + self._world.utc_ns() * 1e-9 / 86_400.0
        return self._model.currents(np.array(around.position), sun.position(date), body, self._generator)
