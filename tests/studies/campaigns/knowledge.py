"""Campaigns `aged-elements` and `calendar`: errors and claimed errors of the predicted environment.

`aged-elements` gives the flight software elements that are up to 60 days old with a B* that is wrong by up to
100 %, and a GPS receiver that is correct, silent or wrong. `calendar` flies a revolution in every month from
2026 to 2036, over the rollover of the GPS week in November 2038, and over a leap second. The fixes are in the
form that the driver reads from NAV-PVT messages; in every second case the date is 1024 weeks early. Each
craft has its own orbit. Its attitude filter estimates its attitude for `FOLLOWED` seconds, with magnetometer
and gyro alone after the first star attitudes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from flight.bodies.orbit.body import description_errors, filter_settings
from flight.bodies.orbit.environment import EstimatedEnvironment, Witness
from flight.loop.navigation import GPS_DELAY_NS
from flight.schema import reader as configuration
from flight.schema.orbit import OrbitConfig, as_orbit
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from hal.drivers.gps import (
    DATE_AND_TIME,
    FIX_OK,
    ROLLOVER_NS,
    THREE_DIMENSIONS,
    Pvt,
    reading_of,
    unpack_pvt,
)
from hal.interfaces.devices import GpsReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.orientation import (
    ROTATION_RATE,
    celestial_to_terrestrial,
    geodetic,
    north_east_down,
    terrestrial_time,
)
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH, sunlit_share
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.free_filter import FilterEnvironment, FreeFilter, FreeMotion
from sim_hal.clock import SimClock
from sim_hal.worlds.orbit import magnetic_field, sun_position
from tests.support.flights import CONFIG

HONEST = 4.0
"""Largest acceptable position error, in units of its claimed sigma."""
SPAN, STEP, USED_WITHIN = 1200, 10, 600
"""Duration (s) of a flight with old elements, time (s) between fixes, and time (s) within which the flight
must use good fixes.
"""
FALSE = ("jump", "shift", "radius", "velocity", "date", "field", "sun")
KINDS = ("good", "good", "good", "good", "silent", "silent", *FALSE)
DAYS_NS = 86_400 * SECOND_NS
STAR_SIGMA = 5e-5
"""Standard deviation (rad) of a star attitude about each axis."""
FIELD_ERROR = 5.0e-8
"""Error (T) of the field model per axis within its validity, as the filter assumes."""


def lines(epoch: datetime, drag: float, angles: Sequence[float], motion: float) -> tuple[str, str]:
    """Return two-line elements for inclination, node, eccentricity, perigee and anomaly (deg)."""
    inclination, node, eccentricity, perigee, anomaly = angles
    day = (epoch - datetime(epoch.year, 1, 1, tzinfo=UTC)) / timedelta(days=1) + 1.0
    power = 0 if drag == 0.0 else math.floor(math.log10(abs(drag))) + 1
    packed = f"{round(abs(drag) / 10.0**power * 1e5):05d}{power:+d}".replace("100000", "99999")
    first = f"1 99001U 26001A   {epoch.year % 100:02d}{day:012.8f}  .00000000  00000-0  {packed} 0  999"
    second = (
        f"2 99001 {inclination:8.4f} {node % 360.0:8.4f} {round(1e7 * eccentricity):07d} "
        f"{perigee % 360.0:8.4f} {anomaly % 360.0:8.4f} {motion:11.8f}00010"
    )
    summed = [
        f"{line}{sum(int(c) if c.isdigit() else c == '-' for c in line) % 10}" for line in (first, second)
    ]
    return summed[0], summed[1]


class Receiver:
    """A GPS receiver on a true orbit; host time is zero at `begin_ns`, UTC ns since 1970."""

    def __init__(self, true: TwoLineElements, begin_ns: int, rng: np.random.Generator) -> None:
        self.true, self.begin_ns, self._rng = true, begin_ns, rng

    def date(self, seconds: float) -> float:
        """Return the Julian date UTC of a time, s."""
        return UNIX_EPOCH + (self.begin_ns + seconds * SECOND_NS) / (DAY * SECOND_NS)

    def reading(self, seconds: float) -> GpsReading:
        """Return the fix at a time (s), with noise."""
        state, turn = self.true.at(self.date(seconds)), celestial_to_terrestrial(self.date(seconds))
        noise = self._rng.standard_normal(6)
        position = turn @ state.position
        velocity = turn @ state.velocity - np.cross([0.0, 0.0, ROTATION_RATE], position) + 0.05 * noise[3:]
        time_ns = round(seconds * SECOND_NS) + GPS_DELAY_NS
        utc_ns = self.begin_ns + round(seconds * SECOND_NS)
        return GpsReading(time_ns, time_ns, utc_ns, position + 3.0 * noise[:3], velocity, 5.0, 0.05, 9, True)

    def error(self, known: EstimatedEnvironment, seconds: float) -> tuple[float, float] | None:
        """Return the error (m) of the predicted position, also relative to its claimed sigma.

        None if unknown.

        Positions are compared in ITRS, because a leap second changes UTC but not the Earth's rotation.
        """
        state, date = known.state(round(seconds * SECOND_NS)), self.date(seconds)
        if state is None:
            return None
        place = celestial_to_terrestrial(state.julian_date) @ state.position
        off = float(np.linalg.norm(place - celestial_to_terrestrial(date) @ self.true.at(date).position))
        return off, off / state.sigma


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights that cycle through the kinds of receivers."""
    kinds = [KINDS[run % len(KINDS)] for run in range(runs)]
    return [Case(f"{run}/{kind}", (seed, run), {"kind": kind}) for run, kind in enumerate(kinds)]


Orbit = tuple[datetime, float, Sequence[float], float]
"""Epoch, B*, angles and mean motion of an orbit, as `lines` takes them."""


def run(case: Case) -> Result:
    """Simulate one receiver with old elements; `step` is the time (s) between two fixes."""
    rng, kind = np.random.default_rng(case.seed), case.parameters["kind"]
    # The magnetometer or the Sun can reveal that a fix is of another orbit only if the orbital elements are
    # accurate.
    age, wrong = rng.uniform(0.0, 2.0 if kind in ("field", "sun") else 60.0), rng.uniform(0.0, 1.0)
    other: Receiver | None = None
    while True:
        orbit = _orbit(rng)
        begin_ns = round(orbit[0].timestamp() + 86_400.0 * age) * SECOND_NS
        receiver = Receiver(TwoLineElements(*lines(*orbit)), begin_ns, rng)
        if kind not in ("field", "sun"):
            break
        epoch, drag, angles, motion = orbit
        ahead = [*angles[:4], angles[4] + rng.uniform(60.0, 300.0)]
        other = Receiver(TwoLineElements(*lines(epoch, drag, ahead, motion)), begin_ns, rng)
        if _contradicts(kind, receiver, other):
            break
    known_drag = orbit[1] * (1.0 + rng.choice([-1.0, 1.0]) * wrong)
    elements = TwoLineElements(*lines(orbit[0], known_drag, *orbit[2:]))
    environment, sent = (
        EstimatedEnvironment(elements, SimClock(begin_ns)),
        _sent(kind, other or receiver, rng),
    )
    bias, ratios, used, unknown = rng.uniform(-5e-7, 5e-7), [], [], 0
    step = case.parameters.get("step", STEP)
    for seconds in range(0, SPAN, step):
        reading = sent(seconds)
        if reading is not None:
            used.append(environment.fix(reading, _witness(kind, receiver, seconds, bias)))
        if seconds % 60 == 0:
            found = receiver.error(environment, seconds)
            unknown += found is None
            ratios += [] if found is None else [found[1]]
    first = used.index(True) * step if True in used else None
    return {
        **case.parameters,
        "age_days": age,
        "wrong": wrong,
        "first_use_s": first,
        "used": sum(used),
        "unknown": unknown,
        "worst": max(ratios, default=0.0),
    }


def _orbit(rng: np.random.Generator) -> Orbit:
    """Return a random low orbit."""
    angles = [rng.uniform(30.0, 98.0), *rng.uniform([0.0, 0.0, 0.0, 0.0], [360.0, 0.002, 360.0, 360.0])]
    return datetime(2026, 11, 1, tzinfo=UTC), rng.uniform(0.5e-4, 5e-4), angles, rng.uniform(14.8, 15.4)


def _measured(receiver: Receiver, seconds: float, *, with_field: bool = True) -> tuple[float, float]:
    """Return the field strength, T (NaN without `with_field`), and the visible fraction of the Sun's disc."""
    date = receiver.date(seconds)
    position = receiver.true.at(date).position
    strength = float(np.linalg.norm(magnetic_field(date, position))) if with_field else math.nan
    return strength, float(sunlit_share(position, sun_position(terrestrial_time(date))))


def _field_sigma(strength: float) -> float:
    """Return the standard deviation (T) of a measured field strength, with a unit's default accuracies."""
    return math.hypot(5e-7, 0.01 * strength) / math.sqrt(3.0)


def _contradicts(kind: str, receiver: Receiver, other: Receiver) -> bool:
    """Return whether field or Sun (by `kind`) at the true position contradict the position `other`."""
    places = [(_measured(receiver, seconds), _measured(other, seconds)) for seconds in range(0, SPAN, 60)]
    if kind == "sun":
        return all(here[1] == 1.0 and there[1] == 0.0 for here, there in places)
    deviations = [(there[0] - here[0]) / _field_sigma(here[0]) for here, there in places]
    return math.sqrt(float(np.mean(np.square(deviations[:7])))) > 6.0


def _witness(kind: str, receiver: Receiver, seconds: int, bias: float) -> Witness:
    """Return the measurements of magnetometer and solar cells on the true orbit.

    A receiver of kind "sun" has only the solar cells.
    """
    strength, share = _measured(receiver, seconds, with_field=seconds % 60 == 0 and kind != "sun")
    measured = None if math.isnan(strength) else strength + bias
    return Witness(measured, _field_sigma(strength), share > 0.5 and kind != "field")


def _sent(kind: str, receiver: Receiver, rng: np.random.Generator) -> Callable[[int], GpsReading | None]:
    """Return the function that gives the fix of the receiver `kind` at each time."""
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    size, factor, back = 10.0 ** rng.uniform(4.0, 6.0), rng.uniform(0.0, 0.9), rng.uniform(3.0, 200.0)

    def sent(seconds: int) -> GpsReading | None:
        sound = receiver.reading(seconds)
        position, velocity, utc_ns = sound.position, sound.velocity, sound.utc_ns
        match kind:
            case "jump":
                position = position + size * rng.standard_normal(3)
            case "shift":
                position = position + size * direction
            case "radius":
                position = position * (0.90 + 0.04 * factor)
            case "velocity":
                velocity = velocity * factor
            case "date":
                utc_ns -= round((60.0 + back) * DAYS_NS)
        made = replace(sound, position=position, velocity=velocity, utc_ns=utc_ns)
        return None if kind == "silent" else made

    return sent


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each kind of receiver."""
    rows = {}
    for kind in dict.fromkeys(KINDS):
        flown = [result for result in results if result["kind"] == kind]
        first = [result["first_use_s"] for result in flown if result["first_use_s"] is not None]
        rows[kind] = {
            "flights": len(flown),
            "used": len(first),
            "latest_first_use_s": max(first, default=None),
            "false_fixes_used": None if kind == "good" else sum(result["used"] for result in flown),
            "unknown": sum(result["unknown"] for result in flown),
            "worst_error_over_claim": max((result["worst"] for result in flown), default=None),
        }
    return summary({"receivers": rows})


AGED_ELEMENTS = Campaign(
    "aged-elements",
    "elements of 0 to 60 days with a wrong B*, and a receiver that is good, silent or false",
    cases,
    run,
    summarise,
    200,
)

CRAFT = {
    "orbit.yaml": None,
    "orbit_3u.yaml": ((51.64, 0.0006, 130.5, 0.0), 15.50),
}
"""Configurations, with inclination, eccentricity, perigee and anomaly (deg) and revolutions per day of their
orbits.

The KnightCube flies the orbit of its configuration, and the 3U that of the ISS.
"""
FOLLOWED, STARS_UNTIL, FILTER_STEP = 300, 60, 2
"""Duration (s) of the attitude estimation, time (s) until which star attitudes are available, and filter
step (s)."""
ROLLOVER = "2038-11-20T23:15:00"
"""UTC three quarters of an hour before the ten-bit week of GPS restarts."""
LEAP = "2035-06-30T23:15:00"
"""UTC shortly before a leap second that this campaign assumes at the end of June 2035."""


def months(runs: int, seed: int) -> list[Case]:
    """Return flights of both craft in `runs` months from January 2026 on, and at two special dates.

    These are a rollover of the GPS week number and a leap second.
    """
    dates = [f"{2026 + month // 12}-{month % 12 + 1:02d}-15T12:00:00" for month in range(min(runs, 132))]
    return [
        Case(f"{craft}/{date}", (seed, number), {"craft": craft, "utc": date, "early": number % 2 == 1})
        for craft in CRAFT
        for number, date in enumerate([*dates, ROLLOVER, LEAP])
    ]


def fly_month(case: Case) -> Result:
    """Fly a revolution with a fix every minute; compare position, Sun, field and eclipse."""
    rng, given = np.random.default_rng(case.seed), case.parameters
    begin = datetime.fromisoformat(given["utc"]).replace(tzinfo=UTC)
    config = as_orbit(configuration.load(CONFIG.parent / given["craft"]))
    assert config.elements is not None
    second = config.elements[1]
    own = (float(second[8:16]), float(f"0.{second[26:33]}"), float(second[34:42]), float(second[43:51]))
    (inclination, *angles), motion = CRAFT[given["craft"]] or (own, float(second[52:63]))
    true = TwoLineElements(*lines(begin, 0.0, [inclination, rng.uniform(0.0, 360.0), *angles], motion))
    receiver = Receiver(true, round(begin.timestamp()) * SECOND_NS, rng)
    known = EstimatedEnvironment(None, SimClock(receiver.begin_ns))
    for seconds in (0, 1, 2):
        known.fix(_as_received(receiver.reading(seconds), given))
    result: Result = {
        "unknown": 0,
        "worst": 0.0,
        "sun_deg": 0.0,
        "field_nt": 0.0,
        "field_sigmas": 0.0,
        "dark": 0,
    }
    wrong = used = 0
    for seconds in range(60, 5700, 60):
        used += known.fix(_as_received(receiver.reading(seconds), given))
        if seconds % 300:
            continue
        found, place = known.at(round((seconds + 20) * SECOND_NS)), receiver.error(known, seconds + 20)
        sun = known.sun(round((seconds + 20) * SECOND_NS))
        if found is None or place is None or sun is None:
            result["unknown"] += 1
            continue
        date = receiver.date(seconds + 20)
        position = true.at(date).position
        light = sun_position(terrestrial_time(date))
        share = float(sunlit_share(position, light))
        off = found.field - magnetic_field(date, position)
        sigma = math.hypot(FIELD_ERROR, found.field_sigma)
        result["worst"] = max(result["worst"], place[1])
        result["sun_deg"] = max(result["sun_deg"], _angle_deg(sun, light - position))
        result["field_nt"] = max(result["field_nt"], 1e9 * float(np.linalg.norm(off)))
        result["field_sigmas"] = max(result["field_sigmas"], float(np.abs(off).max()) / sigma)
        result["dark"] += share == 0.0
        wrong += share in (0.0, 1.0) and abs(found.sunlit - share) > 0.5
    followed = _followed(config, receiver, rng)
    return {**given, **result, "eclipse_wrong": wrong, "used": used, **followed}


class _UnlikeBody:
    """Body and sensors of a craft that differ from its configuration within the stated accuracies."""

    def __init__(self, config: OrbitConfig, rng: np.random.Generator) -> None:
        self._rng, self._unit = rng, config.inertial_unit
        self._field_noise, errors = config.estimation.field_noise, description_errors(config)
        inertia = config.craft.inertia_matrix()
        self._motion = FreeMotion(inertia @ np.diag(1.0 + errors.moments * rng.uniform(-0.5, 0.5, 3)))
        largest = [config.dipole_errors()[0], config.estimation.bias_start]
        largest += [self._unit.accuracy.field_bias, errors.camera]
        dipole, *self._off = np.array(largest)[:, None] * rng.uniform(-1.0, 1.0, (4, 3))
        self._dipole = np.array(config.craft.residual_dipole) + dipole
        quaternion = rng.standard_normal(4)
        self.quaternion, self._rate = quaternion / np.linalg.norm(quaternion), rng.uniform(-2e-3, 2e-3, 3)

    def turn(self, around: FilterEnvironment) -> None:
        """Advance the body by a filter step without currents in the coils."""
        for _ in range(2 * FILTER_STEP):
            torque = self._motion.torque(self.quaternion, np.zeros(3), self._dipole, np.zeros(9), around)[0]
            change = 0.5 * self._motion.acceleration(self._rate, torque)
            turned = from_rotation_vector(0.5 * (self._rate + 0.5 * change))
            self.quaternion, self._rate = multiply(turned, self.quaternion), self._rate + change

    def measured(self, around: FilterEnvironment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the gyro rate, the magnetic field, and the star camera's attitude."""
        noise, (bias, magnet, camera) = self._rng.standard_normal((3, 3)), self._off
        gyro = self._rate + bias + self._unit.rate_noise / math.sqrt(self._unit.rate_hz) * noise[0]
        field = attitude_matrix(self.quaternion) @ around.field + magnet + self._field_noise * noise[1]
        return gyro, field, multiply(from_rotation_vector(camera + STAR_SIGMA * noise[2]), self.quaternion)


def _followed(config: OrbitConfig, receiver: Receiver, rng: np.random.Generator) -> Result:
    """Return a craft's attitude errors: `attitude_deg` at the end, and the largest one in claimed sigmas.

    The latter is `attitude_sigmas`.
    """
    body, unit = _UnlikeBody(config, rng), config.inertial_unit
    free = FreeFilter(config.craft.inertia_matrix(), filter_settings(config))
    known = EstimatedEnvironment(None, SimClock(receiver.begin_ns))
    for second in (0, 1, 2):
        known.fix(receiver.reading(second))
    nothing, worst, end, eye = Pressures(np.zeros((1, 3)), np.zeros((1, 3))), 0.0, 0.0, np.eye(3)
    knots = np.arange(0.0, FOLLOWED + 11.0, 10.0)
    dates = [receiver.date(knot) for knot in knots]
    fields = np.array([magnetic_field(date, receiver.true.at(date).position) for date in dates])
    for second in range(4, FOLLOWED + 1, FILTER_STEP):
        if second % 60 == 0:
            known.fix(receiver.reading(second))
        around = known.at(second * SECOND_NS)
        if around is None:
            return {"attitude_sigmas": math.inf, "attitude_deg": 180.0}
        field = np.array([np.interp(second, knots, part) for part in fields.T])
        position = receiver.true.at(receiver.date(second)).position
        here = FilterEnvironment(field, position, nothing, around.sunlit)
        body.turn(here)
        gyro, field, stars = body.measured(here)
        if not free.started:
            free.start(stars, STAR_SIGMA**2 * eye, gyro, by_stars=True)
            continue
        free.advance(FILTER_STEP, np.zeros(3), around)
        free.gyro(gyro, unit.rate_noise**2 / unit.rate_hz * eye)
        free.field(field, around.field, config.estimation.field_noise**2 * eye)
        if second <= STARS_UNTIL and second % 10 == 0:
            free.attitude(stars, STAR_SIGMA**2 * eye)
        error = to_rotation_vector(multiply(free.quaternion, conjugate(body.quaternion)))
        end = math.degrees(float(np.linalg.norm(error)))
        if second % 60 == 0:
            worst = max(worst, float(np.abs(error / np.sqrt(free.covariance.diagonal()[:3])).max()))
    return {"attitude_sigmas": worst, "attitude_deg": end}


def _angle_deg(one: FloatArray, other: FloatArray) -> float:
    cosine = float(one @ other) / float(np.linalg.norm(one) * np.linalg.norm(other))
    return math.degrees(math.acos(min(1.0, cosine)))


def _as_received(sound: GpsReading, given: Result) -> GpsReading:
    """Return a fix as the driver reads it, with the date of the previous week epoch or a leap second."""
    utc_ns = sound.utc_ns
    leap_ns = round(datetime(2035, 7, 1, tzinfo=UTC).timestamp()) * SECOND_NS
    if given["utc"] == LEAP and utc_ns >= leap_ns:
        utc_ns -= SECOND_NS
    after = (
        given["utc"] != ROLLOVER
        or utc_ns >= round(datetime(2038, 11, 21, tzinfo=UTC).timestamp()) * SECOND_NS
    )
    sent_ns = utc_ns - ROLLOVER_NS if (given["early"] or given["utc"] == ROLLOVER) and after else utc_ns
    when = datetime.fromtimestamp(sent_ns // SECOND_NS, UTC)
    longitude, latitude, height = (float(part) for part in geodetic(sound.position))
    north, east, down = (1e3 * north_east_down(longitude, latitude) @ sound.velocity).tolist()
    pvt = Pvt(
        date=(when.year, when.month, when.day, when.hour, when.minute, when.second),
        nano=sent_ns % SECOND_NS,
        valid=DATE_AND_TIME,
        fix=THREE_DIMENSIONS,
        flags=FIX_OK,
        satellites=9,
        longitude=round(math.degrees(longitude) * 1e7),
        latitude=round(math.degrees(latitude) * 1e7),
        height=round(1e3 * height),
        horizontal=7071,
        vertical=5000,
        velocity=(round(north), round(east), round(down)),
        speed_accuracy=87,
    )
    read = reading_of(unpack_pvt(pvt.packed()), sound.time_ns, 115_200)
    return replace(read, time_ns=sound.time_ns, arrival_ns=sound.time_ns)


_LARGEST = ("worst", "sun_deg", "field_nt", "field_sigmas", "attitude_sigmas", "attitude_deg")


def summarise_months(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each craft, the rollover and the leap second."""
    rows = {}
    for craft in CRAFT:
        flown = [result for result in results if result["craft"] == craft]
        if not flown:
            continue
        rows[craft] = {
            "revolutions": len(flown),
            "unknown": sum(result["unknown"] for result in flown),
            "fixes_refused": sum(94 - result["used"] for result in flown),
            **{name: max(result[name] for result in flown) for name in _LARGEST},
            "dark": sum(result["dark"] for result in flown),
            "eclipse_wrong": sum(result["eclipse_wrong"] for result in flown),
        }
    return summary({"craft": rows})


CALENDAR = Campaign(
    "calendar",
    "place, Sun, field and eclipse in every month of ten years, over the GPS rollover and a leap second",
    months,
    fly_month,
    summarise_months,
    132,
)
