"""Tests of the coil gains estimated from the motion, including stalls of the loop and a free body."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
import pytest

from flight.loop.coil_currents import CoilFault
from flight.loop.coil_monitor import CoilMonitor, CoilMonitorSettings
from flight.loop.coil_response import (
    CoilCorrection,
    CoilResponse,
    Finding,
    MotionFit,
    MotionWitness,
    ResponseSettings,
    _bin_equations,
)
from knightcube.astro.arrays import FloatArray
from tests.support.compiled_forms import assert_forms_agree

FIELD = np.array([0.0, 0.0, 60e-6])
INERTIA, DIPOLE = 0.02, 60.0
TICK_NS = 25_000_000
STAND_EVERY = 176
"""Number of cycles between two stalls of the loop; 176 cycles are 4.4 s."""
STANDS = 36
STALE = 12
"""Number of cycles after which the coil driver or the guardian zeroes an old command."""


def _fly(driver_lets_go: bool, informed: bool, cycles: int = 1200) -> tuple[list[float], int]:
    """Drive coil x by a loop that stalls repeatedly.

    The gyro samples of a stall arrive together at the end of the stall. During a stall the driver zeroes the
    coils and reports the time, or a guardian zeroes them without a report. If `informed` is set, the loop
    knows that the currents during the stall are unknown. Returns the trusted gains of coil x, and the number
    of times that an axis was found reversed.
    """
    settings = ResponseSettings(np.eye(3) * INERTIA, DIPOLE, 1e-4, free=(False, True, False))
    response, noise = CoilResponse(settings), np.random.default_rng(3)
    believed: list[float] = []
    rate, wrong, carried = 0.0, 0, 0.0
    waiting: list[tuple[int, float]] = []
    for cycle in range(cycles):
        now_ns = (cycle + 1) * TICK_NS
        rate += -DIPOLE * carried * FIELD[2] / INERTIA * TICK_NS * 1e-9
        waiting.append((now_ns, rate + 1e-4 * noise.standard_normal()))
        stood = cycle % STAND_EVERY if cycle > STAND_EVERY else STAND_EVERY
        if stood < STANDS:
            carried = carried if stood < STALE else 0.0
            continue
        if stood == STANDS and driver_lets_go:
            response.commanded(now_ns - (STANDS - STALE) * TICK_NS, (0.0, 0.0, 0.0))
        elif stood == STANDS and informed:
            response.interrupted(now_ns)
        for time_ns, seen in waiting:
            if response.observe_motion(time_ns, np.array([0.0, seen, 0.0]), FIELD):
                wrong += len(response.axes(Finding.REVERSED))
                if response.sigma[0] < settings.sure:
                    believed.append(float(response.gain[0]))
        waiting.clear()
        carried = 0.05 * math.sin(2.0 * math.pi * cycle / 160) - 0.3 * rate
        response.commanded(now_ns, (carried, 0.0, 0.0))
    return believed, wrong


def test_a_sound_coil_that_a_guardian_held_at_zero_is_not_reported_as_broken() -> None:
    gains, wrong = _fly(driver_lets_go=False, informed=True)
    assert wrong == 0
    assert len(gains) > 20
    assert np.abs(np.array(gains) - 1.0).max() < 0.2
    misled, _ = _fly(driver_lets_go=False, informed=False)
    assert np.abs(np.array(misled) - 1.0).max() > 0.3, "samples of a time in which others held it do mislead"


def test_samples_that_come_in_a_burst_are_those_of_the_commands_of_their_time() -> None:
    gains, wrong = _fly(driver_lets_go=True, informed=False)
    assert wrong == 0
    assert len(gains) > 100
    assert np.abs(np.array(gains) - 1.0).max() < 0.1


class Orbiting:
    """A tumbling 1U in a field of 37 uT.

    The pulsed coils cause twice the Earth's field at the magnetometer.
    """

    def __init__(
        self,
        signs: FloatArray,
        speed: float = 1.0,
        tumble_rate: float = math.inf,
        dipoles: FloatArray | None = None,
    ) -> None:
        """Use coils with the `dipoles` (3, n) per ampere, by default along the body axes."""
        self.signs, self.rate = signs, speed * np.array([0.08, -0.1, 0.07])
        self._dipoles = 0.65 * np.eye(3) if dipoles is None else dipoles
        self._allocation = 0.65 * np.linalg.pinv(self._dipoles)
        settings = ResponseSettings(
            INERTIAS, self._dipoles, 2.8e-4, bin_samples=16, bins=40, least_bins=20, model_error=2e-4,
            torsion=1e-6, damping=1e-4, settle_ns=100_000_000,
        )  # fmt: skip
        self.response = CoilResponse(settings)
        slow = replace(settings, bin_samples=40, least_bins=8, model_error=3e-5)
        self.watch = CoilMonitor(
            CoilMonitorSettings((0.148,) * len(signs), slow=slow, tumble_rate=tumble_rate)
        )
        self.moments = MOMENTS
        self._noise = np.random.default_rng(4)
        self._cycles = 0
        self._field: FloatArray = np.array([1e-5, -2e-5, 3e-5])

    def fly(self, seconds: float, weak: bool = False) -> None:
        """Simulate the body with coils that are off for 0.2 s of each second.

        If `weak` is set, the currents are too small for the current monitor.
        """
        begun, self._cycles = self._cycles, self._cycles + round(40 * seconds)
        for cycle in range(begun, self._cycles):
            now_ns, within, time = cycle * TICK_NS, cycle % 40, cycle / 40
            wanted = 0.14 * np.sign([math.sin(0.7 * time), math.cos(0.5 * time), 1.0])
            if weak:
                wanted = 0.014 * np.sin([0.2 * time, 0.13 * time + 1.0, 0.17 * time + 2.0])
            wanted = np.where(self.watch.resting, 0.0, self._allocation @ wanted)
            currents = self.watch.correction.wire(wanted) if within >= 8 else np.zeros(len(wanted))
            self.response.commanded(now_ns, tuple(currents.tolist()))
            self.watch.commanded(now_ns, currents)
            dipole = self._dipoles @ (self.signs * currents)
            self.rate, self._field = _moved(self.rate, self._field, dipole, self.moments)
            seen = self._field + 7.7e-4 * self._dipoles @ (self.signs * currents)
            noise = 2.8e-4 * self._noise.standard_normal(3)
            self.response.observe_motion(now_ns + TICK_NS, self.rate + noise, seen)
            self.watch.observe_motion(now_ns + TICK_NS, self.rate + noise, seen)


MOMENTS: FloatArray = np.array([1.10e-3, 1.05e-3, 0.99e-3])
INERTIAS = np.diag(MOMENTS)


def _moved(
    rate: FloatArray, field: FloatArray, dipole: FloatArray, moments: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rate and field (3,) after 25 ms, in body axes.

    Calculations with floats take a tenth of the time that numpy arrays take.
    """
    (x, y, z), (bx, by, bz) = rate.tolist(), field.tolist()
    (mx, my, mz), (jx, jy, jz) = dipole.tolist(), moments.tolist()
    for _ in range(5):
        hx, hy, hz = jx * x, jy * y, jz * z
        tx = (my * bz - mz * by) - (y * hz - z * hy)
        ty = (mz * bx - mx * bz) - (z * hx - x * hz)
        tz = (mx * by - my * bx) - (x * hy - y * hx)
        x, y, z = x + 5e-3 * tx / jx, y + 5e-3 * ty / jy, z + 5e-3 * tz / jz
        vx, vy, vz = y * bz - z * by, z * bx - x * bz, x * by - y * bx
        bx, by, bz = bx - 5e-3 * vx, by - 5e-3 * vy, bz - 5e-3 * vz
    return np.array((x, y, z)), np.array((bx, by, bz))


def test_no_healthy_coil_of_a_free_body_is_found_reversed() -> None:
    sound = Orbiting(np.ones(3))
    sound.fly(60.0)
    assert sound.response.axes(Finding.REVERSED) == []
    assert np.abs(sound.response.gain - 1.0).max() < 0.3


@pytest.mark.parametrize("axis", range(3))
def test_a_reversed_coil_of_a_free_body_is_found_although_its_field_exceeds_that_of_the_earth(
    axis: int,
) -> None:
    signs = np.ones(3)
    signs[axis] = -1.0
    broken = Orbiting(signs)
    broken.fly(60.0)
    assert broken.response.axes(Finding.REVERSED) == [axis]


PYRAMID = 0.4 * np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])


@pytest.mark.parametrize("reversed_coil", [None, 0, 3])
def test_the_reversed_coil_of_four_coils_is_found(reversed_coil: int | None) -> None:
    """A reversed coil of four is found, although the four currents are correlated by their common dipole."""
    signs = np.where(np.arange(4) == reversed_coil, -1.0, 1.0)
    flown = Orbiting(signs, dipoles=PYRAMID)
    flown.fly(60.0)
    assert flown.response.axes(Finding.REVERSED) == ([] if reversed_coil is None else [reversed_coil])
    assert flown.watch.correction.factors.tolist() == signs.tolist()


@pytest.mark.parametrize("gain", [0.0, -1.0])
@pytest.mark.parametrize("axis", range(3))
def test_a_coil_that_makes_no_torque_is_found_at_currents_too_small_for_the_monitor(
    axis: int, gain: float
) -> None:
    signs = np.ones(3)
    signs[axis] = gain
    broken = Orbiting(signs, speed=0.02)
    broken.fly(110.0, weak=True)
    told = broken.watch.suspicion or broken.watch.news()[0]
    assert told.startswith(f"coil {'xyz'[axis]}")
    assert broken.watch.correction.factors.tolist() == np.where(signs < 0.0, -1.0, 1.0).tolist()


@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_no_coil_is_suspected_if_all_coils_are_healthy_or_none_has_an_effect(gain: float) -> None:
    """If no coil has an effect, no coil is suspected, because a wrong gyro or field is more likely."""
    body = Orbiting(np.full(3, gain), speed=0.02)
    body.fly(120.0, weak=True)
    assert body.watch.suspicion == ""
    assert body.watch.verdicts == ()


def test_a_gain_that_no_coil_can_have_gives_no_verdict() -> None:
    body = Orbiting(np.array([-2.5, 1.0, 1.0]))
    body.fly(60.0)
    assert body.response.gain[0] < -1.5
    assert body.response.axes(Finding.REVERSED) == []
    assert body.response.axes(Finding.FEEBLE) == []
    assert not any(body.response.is_healthy(axis) for axis in range(3)), "the model is wrong for all axes"


@pytest.mark.parametrize(("gain", "found"), [(1.3, [0]), (1.7, [])])
def test_a_coil_stronger_than_possible_is_neither_sound_nor_strong(gain: float, found: list[int]) -> None:
    response = CoilResponse(ResponseSettings(INERTIAS, 0.65, 2.8e-4))
    response.gain, response.sigma = np.array([gain, 1.0, 1.0]), np.full(3, 0.01)
    for _ in range(3):
        response._count(0, True, alone=True, is_reversed=False, is_steady=True)
    assert response.axes(Finding.SOUND) == response.axes(Finding.STRONG) == found


@pytest.mark.parametrize(
    ("possible", "gain", "found"), [(True, -0.9, [0]), (False, -0.9, []), (True, -0.4, [])]
)
def test_an_impossible_or_unclear_fit_of_few_bins_changes_no_sign(
    possible: bool, gain: float, found: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    response = CoilResponse(ResponseSettings(INERTIAS, 0.65, 2.8e-4))
    gains, never = [gain, 1.0, 1.0], (False, False, False)
    short = MotionFit(gains, [0.1] * 3, np.zeros(0), possible, never, (True, False, False))
    whole = MotionFit([1.0] * 3, [0.1] * 3, np.zeros(0), True, never, never)
    response._rows.extend([np.zeros((3, 6))] * 15)
    response._speeds.append(0.1)
    monkeypatch.setattr(response, "_solved", lambda *_: [whole, short])
    for _ in range(3):
        response._fit(0.2)
    assert response.axes(Finding.REVERSED) == found


@pytest.mark.parametrize("axis", range(3))
def test_a_coil_reversed_in_a_tumble_is_used_with_its_sign_changed_and_reviewed_when_slow(axis: int) -> None:
    signs = np.ones(3)
    signs[axis] = -1.0
    body = Orbiting(signs, tumble_rate=0.01)
    body.fly(30.0)
    watch = body.watch
    assert watch.correction.factors.tolist() == signs.tolist()
    assert watch.correction.unreviewed == {axis}
    (told,) = watch.news()
    assert told.startswith(f"coil {'xyz'[axis]}: ")
    assert "used with -1.00" in told
    assert watch.available.all()
    assert not watch.resting.any()
    assert watch.suspicion == ""
    watch.tumble_rate = 10.0  # every rate is now below the tumble rate
    body.fly(40.0)
    assert watch.correction.factors.tolist() == signs.tolist()
    assert watch.correction.unreviewed == frozenset()
    assert "the sign is confirmed" in watch.news()[0]


@pytest.mark.parametrize("axis", range(3))
def test_a_coil_that_becomes_reversed_is_found_though_earlier_bins_show_it_healthy(axis: int) -> None:
    body = Orbiting(np.ones(3), tumble_rate=0.01)
    body.fly(45.0)
    body.signs[axis] = -1.0
    body.fly(16.0)
    assert body.watch.correction.factors.tolist() == body.signs.tolist()


def test_a_sign_changed_wrongly_in_a_tumble_is_changed_back() -> None:
    body = Orbiting(np.ones(3), tumble_rate=0.01)
    body.watch.correction.reverse(2, 0, in_tumble=True)
    body.fly(40.0)
    assert body.watch.correction.factors.tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("axis", "stored", "true"), [(1, -1, 1), (1, 0.5, 1), (1, -0.5, 1), (0, -0.3, 1), (2, 0.5, -1)]
)
def test_the_motion_replaces_a_wrong_factor_of_an_earlier_boot_within_a_minute(
    axis: int, stored: float, true: float
) -> None:
    signs, factors, deviations = np.ones(3), np.ones(3), np.zeros(3)
    signs[axis], factors[axis], deviations[axis] = true, stored, 0.05
    body = Orbiting(signs, tumble_rate=0.01)
    assert body.watch.restore(factors, deviations) == ""
    body.fly(55.0)
    assert body.watch.correction.factors == pytest.approx(signs, abs=0.05)


@pytest.mark.parametrize("axis", range(3))
def test_a_weak_coil_is_used_with_its_gain(axis: int) -> None:
    gains = np.ones(3)
    gains[axis] = 0.4
    body = Orbiting(gains)
    body.fly(60.0)
    assert body.watch.correction.factors == pytest.approx(gains, abs=0.1)
    assert body.watch.suspicion == ""


@pytest.mark.parametrize(("gain", "found"), [(0.4, [1]), (0.48, [])])
def test_a_gain_that_misaligned_coils_can_explain_is_not_used(gain: float, found: list[int]) -> None:
    """A gain of 0.48 +- 0.06 is not used, because misaligned coils can explain it.

    In the campaign `unlike-inertia`, a healthy coil of gain 0.8 was estimated to have 0.48 +- 0.06.
    """
    response = CoilResponse(ResponseSettings(INERTIAS, 0.65, 2.8e-4))
    response.gain, response.sigma = np.array([1.0, gain, 1.0]), np.full(3, 0.06)
    for _ in range(3):
        response._count(1, True, alone=True, is_reversed=False, is_steady=True)
    assert response.axes(Finding.WEAK) == found


@pytest.mark.parametrize(("newest", "found"), [(0.45, [1]), (0.2, []), (0.8, [])])
def test_a_gain_that_changed_within_the_bins_is_not_used(
    newest: float, found: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gain of an interval is not used if the newest half of the interval shows another gain.

    The mean gain over an interval with a fault is neither the gain before the fault nor the gain after it.
    """
    response = CoilResponse(ResponseSettings(INERTIAS, 0.65, 2.8e-4))
    alone, never = (False, True, False), (False, False, False)
    fits = {
        bins: MotionFit([1.0, gain, 1.0], [sigma] * 3, np.zeros(0), True, alone, never)
        for bins, gain, sigma in ((16, 0.4, 0.05), (8, newest, 0.07))
    }
    response._rows = deque([np.zeros((3, 6))] * 16)
    response._speeds.append(0.1)
    monkeypatch.setattr(response, "_solved", lambda rows, counts, span: [fits[count] for count in counts])
    for _ in range(3):
        response._fit(0.2)
    assert response.axes(Finding.WEAK) == found


def test_a_coil_assumed_too_weak_gets_its_gain_back() -> None:
    body = Orbiting(np.ones(3))
    body.watch.correction.weigh(0, 0.4)
    body.watch._apply(0, "as if seen", 0)
    body.fly(60.0)
    assert body.watch.correction.factors == pytest.approx(np.ones(3), abs=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_coils_within_their_accuracy_on_an_unlike_body_are_flown_as_described(seed: int) -> None:
    """Coils within 20 % and moments of inertia within 10 % of their configured values are not corrected.

    The motion cannot separate errors of the coils from errors of the inertia.
    """
    noise = np.random.default_rng(seed)
    body = Orbiting(1.0 + 0.2 * noise.choice([-1.0, 1.0], 3))
    body.moments = MOMENTS * (1.0 + 0.1 * noise.uniform(-1.0, 1.0, 3))
    body.fly(90.0)
    assert body.watch.correction.factors.tolist() == [1.0, 1.0, 1.0]
    assert body.watch.suspicion == ""


def test_a_coil_whose_sign_changes_again_and_again_is_kept_at_zero_for_ten_minutes() -> None:
    body = Orbiting(np.array([-1.0, 1.0, 1.0]), tumble_rate=0.01)
    for _ in range(2):
        body.watch.correction.reverse(0, 0, in_tumble=True)
    body.fly(60.0)
    assert body.watch.correction.factors[0] == 1.0
    assert body.watch.resting.tolist() == [True, False, False]
    assert "changed too often" in body.watch.suspicion
    body.watch.observe_motion(700_000_000_000, np.full(3, 0.1), np.full(3, 3e-5))
    assert not body.watch.resting.any()


def test_effective_currents_and_currents_on_the_wire_are_converted_by_sign_and_gain() -> None:
    correction = CoilCorrection()
    assert correction.reverse(1, 5, in_tumble=False)
    assert correction.weigh(2, 0.5)
    assert correction.unreviewed == frozenset()
    assert correction.wire(np.array([0.1, 0.1, 0.1])).tolist() == [0.1, -0.1, 0.2]
    assert correction.effective(np.array([0.1, -0.1, 0.2])).tolist() == [0.1, 0.1, 0.1]
    assert not correction.weigh(0, 1.3), "a coil is never assumed stronger than described"


def test_a_correction_of_an_earlier_boot_is_restored_and_reported() -> None:
    watch = CoilMonitor(CoilMonitorSettings((0.148, 0.148, 0.148)))
    assert watch.restore(np.array([1.0, -0.5, 1.0]), np.array([0.0, 0.2, 0.0])) == ""
    assert watch.correction.factors.tolist() == [1.0, -0.5, 1.0]
    assert watch.correction.deviations.tolist() == [0.0, 0.2, 0.0]
    assert watch.news() == ["coil y: as before the restart; used with -0.50 of its configured dipole"]


@pytest.mark.parametrize("factors", [[1.0, 1.0], [1.0, 0.0, 1.0], [1.0, -1.2, 1.0], [math.nan, 1.0, 1.0]])
def test_an_impossible_correction_of_an_earlier_boot_is_rejected(factors: list[float]) -> None:
    watch = CoilMonitor(CoilMonitorSettings((0.148, 0.148, 0.148)))
    assert "not 3 factors" in watch.restore(np.array(factors), np.zeros(3))
    assert watch.correction.factors.tolist() == [1.0, 1.0, 1.0]
    assert watch.news() == []


def test_the_gain_of_a_weak_coil_is_known_as_well_as_it_was_estimated() -> None:
    correction = CoilCorrection()
    assert correction.weigh(1, 0.4, 0.08)
    assert correction.deviations.tolist() == pytest.approx([0.0, 0.2, 0.0])


def test_the_gain_of_a_coil_that_weakens_repeatedly_stays_one_that_the_next_boot_accepts() -> None:
    correction, next_boot = CoilCorrection(), CoilCorrection()
    assert correction.reverse(0, 5, in_tumble=False)
    assert correction.weigh(0, 0.3)
    assert correction.weigh(0, 0.2)
    assert correction.factors.tolist() == [-0.1, 1.0, 1.0]
    assert not correction.weigh(0, 0.5)
    assert next_boot.restore(correction.factors, correction.deviations) == ""


@pytest.mark.parametrize(("since_ns", "kept"), [(199_999_999, True), (200_000_000, False)])
def test_samples_that_are_200_ms_apart_begin_a_new_fit(since_ns: int, kept: bool) -> None:
    settings = ResponseSettings(np.eye(3) * INERTIA, DIPOLE, 1e-4, free=(False, True, False))
    response = CoilResponse(settings)
    response.observe_motion(1, np.zeros(3), FIELD)
    response.observe_motion(2, np.zeros(3), FIELD)
    assert len(response._samples) == 2
    response.observe_motion(2 + since_ns, np.zeros(3), FIELD)
    assert bool(response._samples) is kept


@pytest.mark.parametrize(("coils", "free", "modes"), [(3, [1], 0), (4, [0, 1, 2], 6)])
def test_the_loop_form_of_the_equations_of_a_bin_equals_the_numpy_form(
    coils: int, free: list[int], modes: int
) -> None:
    rng = np.random.default_rng(coils)
    samples = rng.standard_normal((8, 7 + coils))
    per_field, gyroscopic = rng.standard_normal((3, 3 * coils)), rng.standard_normal((3 + 3 * modes, 6))
    sums, motion = rng.standard_normal((2, 3 * coils + 6)), rng.standard_normal((2, 3))
    for span in (0.2, 0.0):
        args = samples, per_field, gyroscopic, np.array(free), sums, motion, span
        assert_forms_agree(_bin_equations, *args)


def test_before_the_first_fit_no_gain_is_claimed() -> None:
    response = CoilResponse(ResponseSettings(np.eye(3) * INERTIA, DIPOLE, 1e-4))
    assert response.text(1) == "the motion shows +1.00 +- inf of its expected torque"
    assert not any(response.axes(finding) for finding in Finding)
    assert not any(response.is_healthy(axis) for axis in range(3))
    assert math.isnan(response.observed_share(0, 0.0, 1, 2) or 0.0)


class Motion:
    """A test double of the fit with preset results."""

    def __init__(self, share: float | None, healthy: bool) -> None:
        self.share, self.healthy = share, healthy
        self.asked: list[tuple[int, float, int, int]] = []

    def observed_share(self, axis: int, constant: float, since_ns: int, settled_ns: int) -> float | None:
        """Return the fraction of a suspected change that was observed."""
        self.asked.append((axis, constant, since_ns, settled_ns))
        return self.share

    def is_healthy(self, axis: int) -> bool:
        """Return whether the gain is healthy."""
        return self.healthy


MINUTE = 60_000_000_000
FULL = (0.1, 0.2, 0.3)


@pytest.mark.parametrize(
    ("share", "fault", "healthy", "wrong"),
    [
        (0.39, CoilFault.OPEN, False, True),
        (0.4, CoilFault.OPEN, True, False),
        (None, CoilFault.OPEN, True, True),
        (None, CoilFault.OPEN, False, False),
        (None, CoilFault.A_HIGH, True, False),
        (math.nan, CoilFault.OPEN, True, True),
        (math.nan, CoilFault.OPEN, False, False),
        (math.nan, CoilFault.B_HIGH, False, True),
    ],
)
def test_the_motion_contradicts_a_verdict_whose_torque_it_does_not_show(
    share: float | None, fault: CoilFault, healthy: bool, wrong: bool
) -> None:
    witness = MotionWitness(cast(Any, Motion(share, healthy)), FULL)
    assert witness.contradicts(1, fault, 5, 9, MINUTE) is wrong


@pytest.mark.parametrize(
    ("fault", "carried"), [(CoilFault.OPEN, 0.0), (CoilFault.A_HIGH, 0.2), (CoilFault.B_HIGH, -0.2)]
)
def test_a_leg_stuck_high_is_expected_to_drive_its_coil_fully(fault: CoilFault, carried: float) -> None:
    motion = Motion(1.0, True)
    MotionWitness(cast(Any, motion), FULL).contradicts(1, fault, 5, 9, MINUTE)
    assert motion.asked == [(1, carried, 5, 9)]


@pytest.mark.parametrize(("since_ns", "wrong"), [(MINUTE - 1, True), (MINUTE, False)])
def test_for_a_minute_after_a_false_verdict_the_monitor_is_not_believed_alone(
    since_ns: int, wrong: bool
) -> None:
    witness = MotionWitness(cast(Any, Motion(None, False)), FULL)
    witness.doubt_monitor("false", 7)
    assert witness.doubt == "false"
    assert witness.contradicts(0, CoilFault.OPEN, 0, 0, 7 + since_ns) is wrong
    witness.trust_monitor()
    assert witness.doubt == ""


def test_without_the_motion_nothing_is_contradicted() -> None:
    assert not MotionWitness(None, FULL).contradicts(0, CoilFault.OPEN, 0, 0, 0)


def _point_in_dense_air(
    disturbance: float | None, seed: int, gains: tuple[int, int, int] = (1, 1, 1)
) -> tuple[dict[Finding, int], FloatArray]:
    """Simulate coils with the given `gains`, which hold an attitude for 150 s against a varying torque.

    Returns for each finding how often a fit had it on an axis, and the errors of the gains in standard
    deviations.
    """
    settings = ResponseSettings(
        INERTIAS, 0.65 * np.eye(3), 2.8e-4, bin_samples=40, bins=40, least_bins=8, model_error=3e-5,
        torsion=1e-6, damping=1e-4,
        disturbance=None if disturbance is None else lambda _: np.full(3, disturbance),
    )  # fmt: skip
    response, generator = CoilResponse(settings), np.random.default_rng(seed)
    angle, rate, currents = np.zeros(3), np.zeros(3), np.zeros(3)
    phase, period = generator.uniform(0.0, 6.0, 3), generator.uniform(100.0, 300.0)
    found = dict.fromkeys(Finding, 0)
    errors = []
    for cycle in range(6000):
        time, now_ns = cycle / 40, cycle * TICK_NS
        field = 3e-5 * np.array([math.sin(4e-3 * time + phase[0]), math.cos(4e-3 * time + phase[0]), 0.3])
        if cycle % 80 == 0:
            wanted = -MOMENTS * (4e-4 * angle + 4e-2 * rate)
            currents = np.clip(np.cross(field, wanted) / (0.65 * field @ field), -0.148, 0.148)
        response.commanded(now_ns, tuple(currents.tolist()))
        air = 3e-4 * np.sin(2.0 * math.pi * time / period + phase)
        rate = rate + (np.cross(0.65 * np.array(gains) * currents, field) / MOMENTS + air) / 40
        angle = angle + rate / 40
        if response.observe_motion(now_ns + TICK_NS, rate + 2.8e-4 * generator.standard_normal(3), field):
            for finding in Finding:
                found[finding] += len(response.axes(finding))
            errors.append((response.gain - 1.0) / response.sigma)
    return found, np.abs(errors)


def test_no_healthy_coil_looks_reversed_in_dense_air() -> None:
    misled = 0
    for seed in range(2):
        found, errors = _point_in_dense_air(3e-4, seed)
        assert found[Finding.REVERSED] == found[Finding.FEEBLE] == found[Finding.WEAK] == 0
        assert np.mean(errors > 3.0) < 0.02
        misled += _point_in_dense_air(None, seed)[0][Finding.REVERSED]
    assert misled > 0, "a fit that assumes a constant disturbance is misled"
    assert _point_in_dense_air(3e-4, 1, (-1, 1, 1))[0][Finding.REVERSED] > 0, "a reversed coil is still found"


def _constant(value: FloatArray, _: int) -> FloatArray:
    return value


def test_a_disturbance_about_one_axis_affects_only_the_gains_that_act_about_it() -> None:
    """The field is along y, so coil x acts only about z, and coil z only about x."""
    sigmas = []
    for size in (0.0, 3e-3):
        disturbance = np.array([size, 0.0, 0.0])
        settings = ResponseSettings(
            INERTIAS, 0.65 * np.eye(3), 2.8e-4, model_error=3e-5, disturbance=partial(_constant, disturbance)
        )
        response, generator = CoilResponse(settings), np.random.default_rng(2)
        rate, field, currents = np.zeros(3), np.array([0.0, 3e-5, 0.0]), np.zeros(3)
        for cycle in range(800):
            if cycle % 40 == 0:
                currents = generator.uniform(-0.148, 0.148, 3)
            response.commanded(cycle * TICK_NS, tuple(currents.tolist()))
            rate = rate + np.cross(0.65 * currents, field) / MOMENTS / 40
            noise = 2.8e-4 * generator.standard_normal(3)
            response.observe_motion((cycle + 1) * TICK_NS, rate + noise, field)
        sigmas.append(response.sigma)
    assert sigmas[1][0] == pytest.approx(sigmas[0][0], rel=0.05)
    assert sigmas[1][2] > 1.5 * sigmas[0][2]


@pytest.mark.parametrize("tilt", [-0.052, 0.052])
@pytest.mark.parametrize("gain", [1.0, 0.0])
def test_a_tilted_strong_coil_does_not_falsify_the_gain_of_a_weak_coil(tilt: float, gain: float) -> None:
    """The strong coil y is tilted by 4 deg in a field along its axis; the weak coil z has half its dipole.

    The commands of both coils are proportional, as at the end of detumbling. The gain of a healthy weak coil
    is estimated within its uncertainty, and a weak coil without torque is found.
    """
    configured = np.diag([0.65, 0.65, 0.3])
    true = configured + 0.65 * tilt * np.outer([-1.0, 0.0, -1.0], [0.0, 1.0, 0.0])
    true[:, 2] *= gain
    settings = ResponseSettings(
        INERTIAS, configured, 2.8e-4, bin_samples=40, bins=40, least_bins=8, model_error=3e-5,
        torsion=1e-6, damping=1e-4, settle_ns=100_000_000,
    )  # fmt: skip
    response, noise = CoilResponse(settings), np.random.default_rng(5)
    rate, field = np.array([-0.009, -0.012, 0.02]), np.array([5e-6, -4.3e-5, -5e-6])
    feeble = False
    for cycle in range(1600):
        now_ns = cycle * TICK_NS
        currents = math.exp(-cycle / 600) * np.array([0.0, -0.14, -0.1]) * float(cycle % 160 >= 8)
        response.commanded(now_ns, tuple(currents.tolist()))
        rate, field = _moved(rate, field, true @ currents, MOMENTS)
        measured = rate + 2.8e-4 * noise.standard_normal(3)
        response.observe_motion(now_ns + TICK_NS, measured, field + 7.7e-4 * true @ currents)
        feeble = feeble or 2 in response.axes(Finding.FEEBLE)
    if gain:
        assert (np.abs(response.gain - 1.0) < 3.0 * response.sigma).all()
        assert response.sigma[1:].max() < 0.15
    assert feeble == (not gain)
