"""Tests of an orbit run's results: pointing, requirements, residual dipole, and use of the star camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

from flight.link import events
from flight.link.events import Mode
from flight.link.telemetry import definitions as table
from flight.link.telemetry.definitions import ORBIT_TRUTH, SPIN, Packet
from flight.link.telemetry.log import FlightLog
from flight.link.telemetry.packets import Layout, Packer, PacketArray
from flight.schema import reader
from flight.schema.bodies import OrbitConfig, as_orbit
from ground.identification.orbit import learned_lens
from ground.report import draw, summarise
from ground.report.orbit import JUDGED, dipole_errors, pointing, star_camera
from ground.report.text import _lens
from ground.telemetry import Run, read_run
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.quaternion import from_rotation_vector, multiply
from tests.manual_clock import ManualClock
from tests.support.flights import CONFIG
from tests.support.packed_run import packed_run

if TYPE_CHECKING:
    from ground.report.panels import RunSignals

NAN3 = (math.nan,) * 3
PERIOD_S, SECOND_AIM_S, SLEWED_S, DURATION_S = 10, 1000, 1700, 2000
OFF_DEG = (3.0, 4.0, 12.0)
"""Pointing errors (deg) about x, y and z after settling. Before settling, the errors are ten times larger."""
LIMITS = "requirements: {slow_within: 100.0, knowledge_deg: 0.1, pointing_deg: %s}"


def flown(folder: Path, limit_deg: float) -> Path:
    """Write a run whose attitude differs from two targets by `OFF_DEG`, with its configuration and logs."""
    clock, packer = ManualClock(0), Packer()
    flight, truth = (
        FlightLog(folder, stem, clock=clock, sync_period_ns=None) for stem in ("flight", "truth")
    )
    text = CONFIG.with_name("orbit.yaml").read_text(encoding="utf-8")
    begin, end = text.index("requirements:"), text.index("executive:")
    limits = LIMITS % limit_deg
    (folder / "config.yaml").write_text(f"{text[:begin]}{limits}\n\n{text[end:]}", encoding="utf-8")
    target = from_rotation_vector(np.array([0.3, -0.2, 1.0]))
    for at in range(0, DURATION_S, PERIOD_S):
        stamp = at * 1_000_000_000
        clock.sleep_until_ns(stamp)
        if at % SECOND_AIM_S == 0:
            event = {"code": events.TARGET.code, "name": "target", "severity": 0, "suppressed": 0}
            flight.write(packer.pack(table.EVENT, stamp, **event, text="sun" if at == 0 else "nadir"))
        if at == SLEWED_S:
            ended = {"code": events.SLEW_ENDED.code, "name": "slew-ended", "severity": 0, "suppressed": 0}
            flight.write(packer.pack(table.EVENT, stamp, **ended, text=""))
        settled = at % SECOND_AIM_S >= (600 if at < SECOND_AIM_S else SLEWED_S - SECOND_AIM_S)
        off = np.radians(OFF_DEG) * (1.0 if settled else 10.0)
        true = multiply(from_rotation_vector(off), target).tolist()
        wanted = {"wanted": [math.nan] * 4, "wanted_rate": NAN3, "target": target.tolist(), "dipole": NAN3}
        sigma = {"angle_sigma": (1e-4,) * 3, "rate_sigma": (1e-5,) * 3}
        known = {"mode": int(Mode.POINT), "quaternion": target.tolist(), "rate": NAN3}
        flight.write(packer.pack(table.ATTITUDE, stamp, **known, **sigma, **wanted))
        flight.write(
            packer.pack(
                SPIN, stamp, known=0, rate=NAN3, rate_sigma=1.0, field=NAN3, restarts=0, dipole=(0.0,) * 3
            )
        )
        coils = {"current": (0.0,) * 3, "energy": 0.002 * at, "supply_energy": 0.03 * at}
        truth.write(packer.pack(table.TRUTH, stamp, quaternion=true, rate=(0.0, 0.001, 0.0), **coils))
        turn = 2.0 * math.pi * at / 5700.0
        place = [7e6 * math.cos(turn), 0.0, 7e6 * math.sin(turn)]
        torques = {f"{name}_torque": NAN3 for name in ("coil", "dipole", "gravity", "drag", "sunlight")}
        around = {"velocity": NAN3, "field": (2e-5, 0.0, 1e-5), "sun": NAN3, "residual_dipole": NAN3}
        sky = {"utc": 2461000.5 + at / 86400.0, "position": place, "sunlit": float(at < 1500)}
        truth.write(packer.pack(ORBIT_TRUTH, stamp, **sky, **around, **torques))
    flight.close()
    truth.close()
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run whose axis error is 5 deg, while the requirement is 4.9 deg."""
    place = tmp_path_factory.mktemp("orbit")
    return flown(place, 4.9)


def test_each_target_is_judged_by_the_true_attitude_once_settled(folder: Path) -> None:
    found = summarise(read_run(folder))["pointing"]
    assert found["source"] == "truth"
    assert [(aim["target"], aim["begin_s"], aim["duration_s"]) for aim in found["targets"]] == [
        ("sun", 0.0, 990.0),
        ("nadir", 1000.0, 990.0),
    ]
    for aim in found["targets"]:
        assert math.degrees(aim["axis_rms_rad"]) == pytest.approx(5.0), "x and y; z is the axis that points"
        assert math.degrees(aim["all_axes_rms_rad"]) == pytest.approx(13.0)
        assert aim["supply_w"] == pytest.approx(0.03)
        assert aim["heat_w"] == pytest.approx(0.002)


def test_requirements_are_judged_and_what_cannot_be_known_is_unknown(folder: Path, tmp_path: Path) -> None:
    verdicts = {row["quantity"]: row["verdict"] for row in summarise(read_run(folder))["requirements"]}
    assert verdicts == {
        "detumbling time": "unknown",
        "pointing to sun, rms": "miss",
        "pointing to nadir, rms": "miss",
    }
    wider = summarise(read_run(flown(tmp_path, 5.1)))["requirements"]
    assert [row["verdict"] for row in wider] == ["unknown", "pass", "pass"]


def test_without_the_configuration_no_requirement_is_judged_and_the_report_states_it(
    folder: Path, tmp_path: Path
) -> None:
    for log in folder.glob("*.ccsds"):
        (tmp_path / log.name).write_bytes(log.read_bytes())
    summary = summarise(read_run(tmp_path))
    assert summary["pointing"] is None
    assert summary["requirements"] == []
    assert any(note.startswith("pointing and requirements not judged") for note in summary["notes"])


def power_labels(signals: RunSignals) -> list[str]:
    """Return the texts of the legend in the plot of the coil power."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    from ground.report import panels  # noqa: PLC0415 - needs matplotlib

    ax = Figure().subplots()
    panels.power(ax, signals)
    return ax.get_legend_handles_labels()[1]


def test_a_downloaded_log_without_truth_is_reported_to_its_end(folder: Path, tmp_path: Path) -> None:
    for name in ("flight-0001.ccsds", "config.yaml"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    run = read_run(tmp_path)
    assert summarise(run)["run"]["duration_s"] == DURATION_S - PERIOD_S
    pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")
    from ground.report.figures import pointing_figure  # noqa: PLC0415 - needs matplotlib
    from ground.report.panels import RunSignals  # noqa: PLC0415 - needs matplotlib

    assert not any("thesis" in text for text in power_labels(RunSignals(read_run(folder))))
    signals = RunSignals(run)
    assert signals.end == DURATION_S - PERIOD_S
    figure, with_power = pointing_figure(signals), pointing_figure(RunSignals(read_run(folder)))
    assert figure is not None
    assert with_power is not None
    titles = [[ax.get_title(loc="left") for ax in drawn.axes] for drawn in (figure, with_power)]
    assert [sum(title.startswith("Coil power") for title in found) for found in titles] == [0, 1]


def test_the_pictures_of_an_orbit_are_drawn(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")
    names = {path.stem for path in draw(read_run(folder), tmp_path)}
    assert {"pointing", "track"} <= names


SHADOW, END = 2 * JUDGED, 3 * JUDGED
"""Times (s) of the start of the shadow and of the end of the run."""
TRUE = np.array([6e-4, 0.0, 8e-4])


def dipole_flight(known: bool = True) -> Run:
    """Return a run whose relative dipole error is 50 %, later 10 %, and in shadow 20 %."""
    times = np.arange(END)
    share = np.where(times < SHADOW - JUDGED, 0.5, np.where(times < SHADOW, 0.1, 0.2))
    packets = np.zeros(END, dtype=[("time_ns", "i8"), ("residual_dipole", "f8", 3)])
    truth = np.zeros(END, dtype=[("time_ns", "i8"), ("residual_dipole", "f8", 3), ("sunlit", "f8")])
    packets["time_ns"] = truth["time_ns"] = times * 1_000_000_000
    packets["residual_dipole"] = TRUE * (1.0 + share[:, None]) if known else math.nan
    truth["residual_dipole"], truth["sunlit"] = TRUE, times < SHADOW
    return cast(Run, {"navigation": packets, "orbit_truth": truth})


def test_the_last_ten_minutes_of_each_light_are_judged() -> None:
    found = dipole_errors(dipole_flight())
    assert found["sunlight"] == pytest.approx(0.1)
    assert found["shadow"] == pytest.approx(0.2)


def test_without_an_estimate_the_errors_of_the_dipole_are_unknown() -> None:
    assert all(math.isnan(share) for share in dipole_errors(dipole_flight(known=False)).values())


LAST_S = 200
"""Duration (s) of the run."""
PERIOD, FINE_PERIOD, FINE_FROM = 5, 10, 100
"""Periods (s) of the configured camera, and the time (s) from which the attitude quality is "fine"."""
FAST_UNTIL, HIDDEN = 20, (50, 80)
"""Time (s) until which the body is too fast for the camera, and interval (s) with the Earth in the
exclusion cone."""


def packets(packet: Packet, times: list[float], **fields: Any) -> PacketArray:
    """Return packets at times (n,), s. Fields that are not given are zero."""
    rows = np.zeros(len(times), dtype=Layout(packet).dtype)
    rows["time_ns"] = (np.array(times) * 1e9).astype(np.int64)
    for name, values in fields.items():
        rows[name] = values
    return rows


def config() -> OrbitConfig:
    """Return a configuration whose camera points along body +z and is used up to a rate of 0.02 rad/s."""
    found = as_orbit(reader.load(CONFIG.with_name("orbit.yaml")))
    assert found.camera is not None
    assert (found.camera.period, found.camera.fine_period) == (PERIOD, FINE_PERIOD)
    return reader.replace(
        found, camera=reader.replace(found.camera, mounting=(0.0, 0.0, 0.0, 1.0), max_rate=0.02)
    )


def flight(gave: list[float]) -> Run:
    """Return a run whose frames at the times `gave` (s) give a rate and an attitude alternately.

    The camera points to the zenith, with the Sun behind the Earth. During `HIDDEN` the camera points to the
    limb.
    """
    seconds = [float(at) for at in range(LAST_S + 1)]
    limb = math.pi - math.asin(EARTH_RADIUS / 7e6) - 0.1
    down = [HIDDEN[0] <= at < HIDDEN[1] for at in seconds]
    turns = np.array([[0.0, limb, 0.0] if turned else [0.0, 0.0, 0.0] for turned in down])
    rates = np.array([[0.0, 0.0, 0.1 if at < FAST_UNTIL else 0.001] for at in seconds])
    numbers = np.arange(len(gave))
    nan = np.full((len(gave), 4), math.nan)
    nan[1::2] = [0.0, 0.0, 0.0, 1.0]
    return cast(
        Run,
        {
            "truth": packets(table.TRUTH, seconds, quaternion=from_rotation_vector(turns), rate=rates),
            "orbit_truth": packets(
                table.ORBIT_TRUTH, seconds, position=[0.0, 0.0, 7e6], sun=[0.0, 0.0, -1.0]
            ),
            "navigation": packets(
                table.NAVIGATION, seconds, knowledge=[2 if at >= FINE_FROM else 1 for at in seconds]
            ),
            "streak": packets(
                table.STREAK,
                [at + 0.5 for at in gave],
                sequence=numbers,
                exposure_start_ns=(np.array(gave) * 1e9).astype(np.int64),
                status=[b"saturated" if number % 2 else b"rate" for number in numbers],
            ),
            "stars": packets(table.STARS, [at + 0.5 for at in gave], sequence=numbers, quaternion=nan),
        },
    )


FIRST_FINE = FINE_FROM + PERIOD
"""First due time (s) of a frame with a fine attitude; the previous frame is due 10 s earlier."""
SLOW = [*range(FAST_UNTIL, FINE_FROM, PERIOD), *range(FIRST_FINE, LAST_S - FINE_PERIOD, FINE_PERIOD)]
FREE = [at for at in SLOW if not HIDDEN[0] <= at < HIDDEN[1]]


def test_every_unobstructed_instant_counts_and_no_other() -> None:
    found = star_camera(flight([at + 0.3 for at in FREE]), config())
    assert found is not None
    assert found["instants"] == len(SLOW) + FAST_UNTIL // PERIOD
    assert found["slow"] == len(SLOW)
    assert found["unobstructed"] == found["measured"] == len(FREE)
    assert (found["share"], found["longest_gap_s"]) == (1.0, 0.0)


def test_missing_measurements_lower_the_share_and_the_longest_gap_is_stated() -> None:
    missing = [20, 25, 115, 125, 135]
    found = star_camera(flight([at + 0.3 for at in FREE if at not in missing]), config())
    assert found is not None
    assert found["share"] == pytest.approx(1.0 - len(missing) / len(FREE))
    assert found["longest_gap_s"] == 3 * FINE_PERIOD


def test_instants_before_a_log_whose_oldest_segments_were_deleted_do_not_count() -> None:
    run = cast(dict[str, PacketArray], flight([at + 0.3 for at in FREE]))
    for name, rows in run.items():
        run[name] = rows[rows["time_ns"] >= 24 * 10**9]
    found = star_camera(cast(Run, run), config())
    assert found is not None
    assert found["unobstructed"] == found["measured"] == sum(at >= 24 for at in FREE)
    assert (found["share"], found["longest_gap_s"]) == (1.0, 0.0)


@pytest.mark.parametrize(("rate", "period"), [(0.019, FINE_PERIOD), (0.021, PERIOD)])
def test_a_fine_attitude_lengthens_the_period_only_while_the_body_is_slow(rate: float, period: int) -> None:
    run = cast(dict[str, PacketArray], flight([21.0]))
    run["truth"]["rate"] = [0.0, 0.0, rate]
    run["navigation"]["knowledge"] = 2
    camera = config().camera
    assert camera is not None
    found = star_camera(cast(Run, run), reader.replace(config(), camera=reader.replace(camera, max_rate=0.1)))
    assert found is not None
    assert found["instants"] == LAST_S // period


def test_the_sun_in_its_cone_leaves_no_unobstructed_instant() -> None:
    run = cast(dict[str, PacketArray], flight([21.0]))
    run["orbit_truth"]["sun"] = [0.0, 0.5, math.sqrt(0.75)]
    found = star_camera(cast(Run, run), config())
    assert found is not None
    assert found["unobstructed"] == 0
    assert math.isnan(found["share"])


def test_without_a_truth_log_the_star_camera_is_not_judged() -> None:
    run = cast(dict[str, PacketArray], flight([21.0]))
    run["truth"] = run["truth"][:0]
    assert star_camera(cast(Run, run), config()) is None


def test_the_learned_lens_is_that_of_the_last_packet() -> None:
    sigma = [[0.5, 0.4, 0.3, 2e-3, 6e-2, 2e-7, 0.02], [0.1, 0.2, 0.2, 1e-3, 3e-2, 1e-7, 0.01]]
    rows = packets(table.LENS, [1.0, 6.0], frames=[1, 2], focal_length=[900.0, 901.0], sigma=sigma)
    rows["corner_sigma"][1] = 4e-4
    run = cast(Run, {"lens": rows})
    found = learned_lens(run)
    assert found is not None
    assert (found["frames"], found["focal_length_px"]) == (2, [901.0, 0.1])
    text = "\n".join(_lens(found))
    assert "focal length 901.00 +- 0.10 px" in text
    assert "distance of a corner from the centre +- 0.0400 %" in text
    assert "line time 0.00 +- 0.10 us" in text
    assert learned_lens(cast(Run, {"lens": rows[:0]})) is None


def test_pointing_before_the_first_recorded_target_is_reported_without_a_name() -> None:
    point = {"mode": int(Mode.POINT), "quaternion": (0, 0, 0, 1), "target": (0, 0, 0, 1)}
    nadir = {"code": events.TARGET.code, "name": "target", "text": "nadir"}
    run = packed_run(attitude=[(float(at), point) for at in range(0, 2000, 10)], event=[(1000.0, nadir)])
    found = pointing(run, (0.0, 0.0, 1.0), None)
    assert found is not None
    spans = [(row["target"], row["begin_s"], row["duration_s"]) for row in found["targets"]]
    assert spans == [("-", 0.0, 990.0), ("nadir", 1000.0, 990.0)]
