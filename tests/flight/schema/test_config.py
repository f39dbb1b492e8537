"""Tests that a wrong configuration is refused in one line with the wrong value and the permitted values."""

from __future__ import annotations

import contextlib
import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.bodies.orbit.body import filter_settings
from flight.link.commands import Point
from flight.link.events import COMMANDABLE, FOREIGN_MODES
from flight.loop.commanding import command_of
from flight.schema import reader
from flight.schema.bodies import OrbitConfig, TestbedConfig, as_orbit, as_testbed
from flight.schema.devices import likelihood_settings
from flight.schema.document import ConfigError, read_document, to_yaml
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from sim_hal.assembly import camera_model
from sim_hal.settings import Simulation

FOLDER = Path(__file__).resolve().parents[3] / "config"
DEMO = (FOLDER / "step_demo.yaml").read_text(encoding="utf-8")
ORBIT = (FOLDER / "orbit.yaml").read_text(encoding="utf-8").replace(", roll_deg: 188.0}", "}")
SECOND_TARGET = as_orbit(reader.parse(ORBIT, "orbit.yaml")).targets[1].at


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.yaml")), ids=lambda path: path.name)
def test_every_configuration_in_the_repository_is_valid(path: Path) -> None:
    loaded = reader.load(path)
    section = reader.simulation_section(path.read_text(encoding="utf-8"), path.name, Simulation)
    assert (section is None) == (loaded.simulation is None)


@pytest.mark.parametrize("name", ["step_demo.yaml", "step_thesis.yaml", "step_simulation.yaml"])
def test_the_demonstration_is_the_thesis(name: str) -> None:
    loaded = as_testbed(reader.load(FOLDER / name))
    assert [step.at for step in loaded.steps] == [100.0 * k for k in range(7)]
    assert [step.q2 for step in loaded.steps] == pytest.approx([-0.3 + 0.1 * k for k in range(7)])
    assert (loaded.duration, loaded.guidance.horizon, loaded.guidance.replan_period) == (700.0, 10.0, 5.0)
    assert loaded.coils.current_limit == 0.148


def test_the_thesis_configuration_has_the_thesis_control_and_the_world_of_the_demonstration() -> None:
    demo, thesis = (as_testbed(reader.load(FOLDER / name)) for name in ("step_demo.yaml", "step_thesis.yaml"))
    assert (thesis.control.tracker, thesis.guidance.strategy) == ("thesis", "receding")
    assert (thesis.control.state_weight, thesis.control.control_weight) == (20.0, 1.0)
    assert thesis.simulation == demo.simulation
    assert (thesis.plant, thesis.inertial_unit, thesis.coils) == (demo.plant, demo.inertial_unit, demo.coils)


def test_the_simulation_case_is_the_thesis_s() -> None:
    """The file step_simulation.yaml is the case of chapter 5 of the thesis, without suspension and camera.

    The files step_simulation.yaml and step_thesis.yaml have equal sections of control, plant and devices.
    """
    loop, case = (
        as_testbed(reader.load(FOLDER / name)) for name in ("step_thesis.yaml", "step_simulation.yaml")
    )
    assert (case.guidance, case.control, case.coils) == (loop.guidance, loop.control, loop.coils)
    assert (case.plant, case.inertial_unit, case.camera) == (loop.plant, loop.inertial_unit, None)
    text = (FOLDER / "step_simulation.yaml").read_text(encoding="utf-8")
    world = reader.simulation_section(text, "step_simulation.yaml", Simulation)
    assert world is not None
    assert world.release is not None
    assert (world.release.q2, world.release.rate, world.thread.stiffness) == (0.4, 0.015, 0.0)
    assert (world.current_noise, world.imu.quaternion_noise, world.imu.rate_noise) == (
        3.5e-3,
        1.75e-3,
        1.75e-4,
    )


def test_the_thesis_s_camera_model_is_chosen_in_yaml() -> None:
    sky = "latency: {planner: 0.05, vision: 0.25}"
    assert sky in DEMO
    own = DEMO.replace(sky, f"{sky}\n  sky: {{psf: bilinear, noise: uniform}}\n #")
    section = reader.simulation_section(own, "demo.yaml", Simulation)
    loaded = reader.parse(own, "demo.yaml")
    assert section is not None
    assert loaded.camera is not None
    model = camera_model(loaded.camera, section.sky)
    assert (model.psf, model.noise) == ("bilinear", "uniform")
    with pytest.raises(ConfigError, match=r"`simulation.sky.noise` is 'gaussian'"):
        reader.simulation_section(own.replace("uniform", "gaussian"), "demo.yaml", Simulation)


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("supply_voltage: 3.4", "supply_voltage: -3.4", r":30: `coils.supply_voltage` is -3.4: must be"),
        (
            "supply_voltage",
            "suply_voltage",
            "`coils.suply_voltage` is an unknown key, did you mean `supply_voltage`",
        ),
        ("camera:", "kamera:", "did you mean `camera`"),
        ("horizon: 10.0", "horizon: ten", "`guidance.horizon` is 'ten'"),
        ("max_age: 0.1 ", "max_age: 0.06 ", r"`inertial_unit.max_age` is 0.06 s: must be at least 0.075 s"),
        ("q2: 0.1}", "q2: .nan}", r"`steps\[4\].q2` is nan: must be a finite number"),
        ("q2: 0.1}", "q2: 0.9}", r"`steps\[4\].q2` is 0.9"),
        ("{at: 0.0,", "{att: 0.0,", "did you mean `at`"),
        ("at: 200.0", "at: 50", "must be in order of time"),
        ("duration: 700.0", "duration: 600.0", "must be later than the last target, at 600.0 s"),
        (
            "channels: [0, 1]",
            "channels: [0, 2]",
            "use channel 2 of the PWM chip twice: give one of the two coils",
        ),
        ("address: 0x45", "address: 0x40", "is 0x40, which `coils.address` also uses"),
        ("address: 0x45", "address: 45", r"is 0x2d \(45\), but a chip of type ina219 has 0x40 to 0x4f"),
        (
            "address: 0x40",
            "address: 40",
            r"is 0x28 \(40\), but a chip of type pca9685 has 0x40 to 0x77: did you",
        ),
        (
            "camera:",
            "gps: {device: /dev/knightcube-imu}\ncamera:",
            "`gps.device` is /dev/knightcube-imu, which `inertial_unit.device` also uses",
        ),
        ("exposure: 1.0", "exposure: 1.0e-10", "`camera.exposure`.*1e-06"),
        ("exposure: 1.0", "exposure: 6.0", "must be shorter than `camera.period`"),
        ("exposure: 1.0", "exposure: 60.0", r"`camera.exposure` is 60.0: must be 1e-06 to 10 \(s\)$"),
        ("address: 0x40", "address: 0x90", r"`coils.address` is 0x90 \(144\): must be .* to .*"),
        ("psf_sigma: 1.0", "psf_sigma: 0.2", r"`camera.psf_sigma` is 0.2: must be 0.3 to 6 \(px\)$"),
        (
            "line_time: 0.0 ",
            "line_time: 0.02 ",
            r"`camera.line_time` is 0.02: must be 0 to 0.01 \(s per row\)$",
        ),
        ("replan_period: 5.0", "replan_period: 12.0", "must be shorter than `guidance.horizon`"),
        ("name: step-demo", "name: a\nname: b", "`name` is given twice, first in line"),
        ("name: step-demo", "name: [", "is not YAML"),
        ("  inertia:", "\tinertia:", "is not YAML: .*: indent with spaces"),
        ("inertia: 1.05e-3", "inertia: '1.05e-3'", r"is '1.05e-3': .*\): write the number without quotes"),
        ("plant:", "plant: 3\nplant2:", "`plant` is 3"),
        ("thread_stiffness", "stiff", "`plant.stiff` is an unknown key"),
        ("supply_voltage", "supply", "`coils.supply` is an unknown key, did you mean `supply_voltage`"),
        (
            "plant:",
            "craft:",
            ":[0-9]+: `craft` belongs to `body: orbit`, but no `extends` and no `body` is given: ",
        ),
        (
            "plant:",
            "body: testbed\ncraft:",
            "`craft` belongs to `body: orbit`, but `body` is testbed: omit it, or",
        ),
        ("\nsteps:", "\nbody: testbed\ntargets:", "but `body` is testbed: give `steps` instead, or"),
        ("duration: 700.0", "", "`duration` is missing: give the duration of the flight, s"),
        (
            "duration: 700.0",
            "duration: 700 s",
            r"is '700 s': expected a number, got a text .*\): write the number without a unit",
        ),
    ],
)
def test_a_mistake_gets_one_line_with_its_place_and_its_cure(right: str, wrong: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        reader.parse(DEMO.replace(right, wrong, 1), "demo.yaml")
    assert str(caught.value).startswith("demo.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("{at: 0.0, point: sun}", "{at: 1.0, point: sun}", r":\d+: `targets\[0\].at` .* must be given at 0"),
        (f"{{at: {SECOND_TARGET},", "{at: 0.0,", r"`targets\[1\].at` is 0.0: .* in order of time"),
        ("fine_period: 10.0", "fine_period: 3.0", "`camera.fine_period` is 3: .* least `camera.period` .5"),
        ("[0.1, 1.0]", "[1.0, 0.1]", "`camera.streak_exposure`.*must be a minimum"),
        (
            "columns: 512",
            "lens: {focal_length: 2900.0, centre: [514.0, 509.0]}\n  columns: 512",
            r"`camera.lens.centre` is \(514, 509\): .* 512 x 512 pixels; give the lens of",
        ),
        (
            "columns: 512",
            "lens: {focal_length: 1450.0, centre: [256.0, 255.0], k1: -50.0}\n  columns: 512",
            "`camera.lens` is refused: k1 -50.0",
        ),
        (
            "columns: 512",
            "lens: {focal_length: 2900.0, centre: [256.0, 255.0]}\n  columns: 512",
            "is 2900 px: 512 columns then cover 10.09 deg, but `camera.field_of_view_deg` is 20: give both",
        ),
        (
            "columns: 512",
            "bits: 12\n  columns: 512",
            r"`camera.saturation` is 20000: pixels of 12 bits \(`camera.bits`\) have at most 4095 counts",
        ),
        ("point: sun}", "point: moon}", r"`targets\[0\].point` is 'moon'.*nadir"),
        (
            "point: sun}",
            "point: ground, latitude_deg: 4.0}",
            r"`targets\[0\].point` .* needs `longitude_deg`",
        ),
        ("point: sun}", "point: sun, latitude_deg: 4.0}", "belongs to `point: ground`, not to sun"),
        ("point: sun}", "point: ground, lat: 4.0}", r"`targets\[0\].lat` .*did you mean `latitude_deg`"),
        (
            "mass: 0.611",
            "mass: 1.9 kg",
            r"is '1.9 kg': expected a number or nothing, got a text \(mass, kg\)",
        ),
        (
            "field_of_view_deg: 20.0",
            "field_of_view_deg: 0.28",
            "above 1 and below 120: the unit is deg, and 0.28 rad are 16.04 deg",
        ),
        (
            "duration:",
            "magnetometer: {sensors: [{part: lis3mdl, measures: {field: [x, y, z]}}]}\nduration:",
            r"measures.field` is an unknown key: expected one of acceleration, gyro, magnetic",
        ),
        ("point: sun}", "point: inertial, quaternion: [0, 0, 0, 2]}", r"quaternion` has length 2: a quat"),
        (
            "point: sun}",
            "point: inertial, quaternion: [0, 0, 0, 1], roll_deg: 1.0}",
            "includes its roll",
        ),
        (
            "\n  axis: [0.0, 0.0, 1.0]",
            "\n  axis: [0.0, 0.0, 2.0]",
            "`pointing.axis` has length 2: give a unit",
        ),
        ("across: [1.0, 0.0, 0.0]", "across: [0.0, 0.6, 0.8]", "is 36.9 deg from `pointing.axis`"),
        ("duration:", "commands: {timeline: [{at: 1.0, mode: sun, roll_deg: 3.0}]}\nduration:", "to `point`"),
        ("duration:", "commands: {timeline: [{at: 1.0}]}\nduration:", "one of mode, slew, point, clear"),
    ],
)
def test_a_mistake_in_a_satellite_s_targets_gets_one_line(right: str, wrong: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        reader.parse(ORBIT.replace(right, wrong, 1), "orbit.yaml")
    assert str(caught.value).startswith("orbit.yaml:")
    assert "\n" not in str(caught.value)


def _without_description(kind: Any, found: dict[str, None]) -> None:
    """Add to `found` all required numbers and vectors without a description in the sections of a type."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        for one in msgspec.structs.fields(kind):
            texts = [meta.description for meta in getattr(one.type, "__metadata__", ())]
            plain = getattr(one.type, "__origin__", one.type)
            is_number = plain in {int, float} or {*getattr(plain, "__args__", ())} == {float}
            if one.required and is_number and not any(texts):
                found[f"{kind.__name__}.{one.name}"] = None
            _without_description(one.type, found)
    for inner in getattr(kind, "__args__", ()):
        _without_description(inner, found)


@pytest.mark.parametrize("shape", [OrbitConfig, TestbedConfig, Simulation])
def test_every_required_number_has_a_description_with_its_unit(shape: type[Any]) -> None:
    found: dict[str, None] = {}
    _without_description(shape, found)
    assert not found


@pytest.mark.parametrize(
    ("length", "valid"), [(0.9991, True), (1.0009, True), (0.9989, False), (1.0011, False)]
)
def test_a_target_s_quaternion_may_be_rounded_to_a_thousandth(length: float, valid: bool) -> None:
    quaternion = [0.6 * length, 0.0, 0.0, 0.8 * length]
    text = ORBIT.replace("point: sun}", f"point: inertial, quaternion: {quaternion}}}", 1)
    if valid:
        reader.parse(text, "orbit.yaml")
        return
    with pytest.raises(ConfigError, match=f"has length {length:.6g}: a quaternion must have length 1"):
        reader.parse(text, "orbit.yaml")


def test_a_time_line_points_a_satellite_and_never_the_testbed() -> None:
    line = "commands: {timeline: [{at: 9.0, point: ground, latitude_deg: 45, longitude_deg: 9}]}\nduration:"
    step = reader.parse(ORBIT.replace("duration:", line, 1), "orbit.yaml").commands.timeline[0]
    assert command_of(step) == Point(PointingTarget(Goal.GROUND, (math.radians(45.0), math.radians(9.0))))
    with pytest.raises(ConfigError, match=r"`commands.timeline\[0\].point` is a command for satellites"):
        reader.parse(DEMO.replace("duration:", line, 1), "demo.yaml")


@pytest.mark.parametrize(
    ("text", "step", "complaint"),
    [
        (ORBIT, "slew: 0.1", r"\[0\].slew` is a command for the testbed: use `point` for a satellite"),
        (
            ORBIT,
            "mode: hold",
            r"\[0\].mode` is hold: this body can be commanded to safe, detumble, sun, point",
        ),
        (DEMO, "mode: sun", r"\[0\].mode` is sun: this body can be commanded to safe, detumble, hold, testb"),
    ],
)
def test_a_time_line_has_only_commands_of_its_body(text: str, step: str, complaint: str) -> None:
    line = f"commands: {{timeline: [{{at: 9.0, {step}}}]}}\nduration:"
    with pytest.raises(ConfigError, match=complaint):
        reader.parse(text.replace("duration:", line, 1))


@pytest.mark.parametrize("body", ["testbed", "orbit"])
def test_the_modes_of_a_time_line_are_those_that_the_flight_accepts(body: str) -> None:
    foreign = {mode.label for mode in FOREIGN_MODES[body]}
    assert {*reader._COMMANDED[body]} == {mode.label for mode in COMMANDABLE} - foreign - {"slew"}


def test_a_file_without_most_sections_is_refused_with_a_hint_to_extend() -> None:
    with pytest.raises(
        ConfigError, match=r"^one\.yaml: has no `inertial_unit`, .*: give them, or add `extends"
    ):
        reader.parse("name: one\n", "one.yaml")


def test_a_satellite_that_follows_an_object_needs_a_camera_and_both_angles() -> None:
    place = "point: object, right_ascension_deg: 90, declination_deg: -30"
    own = ORBIT.replace("star_tracker: {}", "star_tracker: {}\n  objects: {}", 1)
    line = f"commands: {{timeline: [{{at: 9.0, {place}}}]}}\nduration:"
    step = reader.parse(own.replace("duration:", line, 1), "orbit.yaml").commands.timeline[0]
    assert command_of(step) == Point(PointingTarget(Goal.OBJECT, (math.radians(90.0), math.radians(-30.0))))
    for text, complaint in (
        (line.replace(", declination_deg: -30", ""), r"is object: needs `declination_deg`"),
        (line.replace("declination_deg: -30", "roll_deg: 3, declination_deg: -30"), "free roll"),
        (line.replace("object", "sun"), "belongs to `point: object`"),
    ):
        with pytest.raises(ConfigError, match=complaint):
            reader.parse(own.replace("duration:", text, 1), "orbit.yaml")
    blind = re.sub(r"targets:\n  - .*", "targets:\n  - {at: 0.0, point: object}", ORBIT, count=1)
    with pytest.raises(ConfigError, match=r"`targets\[0\].point` is object: needs `camera`"):
        reader.parse(blind, "orbit.yaml")


def test_mistakes_in_the_simulation_section_are_reported_with_their_place_too() -> None:
    text = DEMO.replace("current_noise: 3.5e-3", "curent_noise: 3.5e-3")
    with pytest.raises(ConfigError, match=r"`simulation.curent_noise` .* did you mean `current_noise`"):
        reader.simulation_section(text, "demo.yaml", Simulation)


def test_numbers_without_a_point_are_numbers() -> None:
    text = DEMO.replace("inertia: 1.05e-3", "inertia: 2e-3")
    assert as_testbed(reader.parse(text)).plant.inertia == 2e-3


def test_the_shipped_testbed_has_no_camera() -> None:
    assert reader.load(FOLDER / "testbed.yaml").camera is None


def test_a_camera_is_read_from_a_configuration_or_from_a_file_of_its_own(tmp_path: Path) -> None:
    whole, own = FOLDER / "orbit.yaml", tmp_path / "camera.yaml"
    own.write_text("camera: {columns: 640, rows: 480, field_of_view_deg: 12.0}\n", encoding="utf-8")
    assert reader.load_camera(whole) == reader.load(whole).camera
    assert reader.load_camera(whole).columns == 512
    camera = reader.load_camera(own)
    assert (camera.columns, camera.rows, camera.field_of_view_deg) == (640, 480, 12.0)
    own.write_text("camera: none\n", encoding="utf-8")
    for path in (own, FOLDER / "testbed.yaml"):
        with pytest.raises(ConfigError):
            reader.load_camera(path)
    with pytest.raises(ConfigError, match="`camera` is none: give a configuration with a camera"):
        reader.load_camera(FOLDER / "testbed.yaml")


def test_a_missing_file_and_a_list_are_clear_errors(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        reader.load(tmp_path / "nothing.yaml")
    with pytest.raises(ConfigError, match="is not a mapping: give lines of the form `key: value`"):
        reader.parse("- 1\n- 2\n")


@given(st.text(max_size=200))
def test_no_text_whatever_makes_a_traceback(text: str) -> None:
    with pytest.raises(ConfigError):
        reader.parse(text)


@settings(max_examples=60)
@given(st.integers(min_value=0, max_value=len(DEMO) - 1), st.characters(), st.integers(0, 20))
def test_a_damaged_configuration_is_valid_or_refused_clearly(place: int, letter: str, cut: int) -> None:
    damaged = DEMO[:place] + letter + DEMO[place + cut :]
    with contextlib.suppress(ConfigError):  # an exception of any other type is a failure
        reader.parse(damaged)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: &x 1\nb: *x\n", r"demo:2: is not YAML: an alias \(\*\): write the value out"),
        ("[" * 1500, "demo: is nested too deeply"),
        ("a: !!int x\n", "demo: is not YAML: invalid literal"),
        ("a: !!bool maybe\n", "demo: is not YAML"),
        ("a: " + "9" * 5000, "demo: is not YAML"),
        ("a: 1\n---\nb: 2\n", "demo:2: is not YAML"),
        ("a: {b: 1, c: [.inf]}\n", r"demo:1: `a.c\[0\]` is inf"),
        ("a:\n  b: 1\n  b: 2\n", "demo:3: `a.b` is given twice, first in line 2"),
        ("!!python/object:os.system x", "demo:1: is not YAML"),
    ],
)
def test_text_that_is_not_a_plain_tree_is_refused_with_its_line(text: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=f"^{complaint}") as caught:
        reader.parse(text, "demo")
    assert "\n" not in str(caught.value)


def test_a_configuration_is_written_in_its_order_and_read_back_the_same() -> None:
    values = {
        "z": 1e-05,
        "a": ["1e5", "yes", "0x40", "none", None, True],
        "text": "é: [\n",
        "pair": (1, -0.0),
    }
    text = to_yaml(values)
    assert list(read_document(text, "written").values) == list(values)
    assert read_document(text, "written").values == values | {"pair": [1, -0.0]}


def test_the_fit_of_streaks_has_the_stated_accuracy_of_the_camera() -> None:
    demo = reader.load(FOLDER / "step_demo.yaml").camera
    assert demo is not None
    exact = likelihood_settings(demo)
    assert (exact.knowledge.centre, exact.knowledge.distortion, exact.line_time_sigma) == (0.0, 0.0, 0.0)
    accuracy = "accuracy: {centre: 0.0, distortion: 0.0}"
    camera = reader.parse(DEMO.replace(accuracy, "accuracy: {centre: 3.0, distortion: 0.01}"), "text").camera
    assert camera is not None
    stated = likelihood_settings(camera).knowledge
    assert (stated.centre, stated.distortion) == (3.0, 0.01)


COIL = "{axis: [0.0, 0.0, 1.0], dipole_per_ampere: 0.648, resistance: 23.0, channels: [4, 5]}"


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        (COIL.replace("1.0]", "0.0]"), r"windings\[2\].axis` is \[0.0, 0.0, 0.0\]: give the direction"),
        (COIL.replace("dipole_per_ampere: 0.648", "turns: 80, area: 0.0"), r"area` is 0.0"),
        (
            COIL.replace("dipole_per_ampere: 0.648, ", ""),
            r"windings\[2\].dipole_per_ampere` is missing",
        ),
        (COIL.replace("648", "648, turns: 80, area: 0.0081"), "omit `turns` and `area`"),
        (COIL.replace("dipole_per_ampere: 0.648", "turns: 80"), r"windings\[2\].turns` needs both"),
        (COIL.replace("23.0", "46.0"), "`coils.current_limit` is 0.148: the supply can drive only 0.0739 A"),
        (
            COIL.replace("23.0", "23.0, current_limit: 0.2"),
            r"\[2\].current_limit` is 0.2: the supply",
        ),
        (
            "\n    - ".join(COIL.replace("[4, 5]", f"[{4 + 2 * k}, {5 + 2 * k}]") for k in range(5)),
            "has 7 entries: 2 to 6 coils are supported",
        ),
        (
            "\n    - ".join(
                COIL.replace("[4, 5]", f"[{4 + 2 * k}, {5 + 2 * k}]").replace(
                    "[0.0, 0.0, 1.0]", "[1.0, 2.0, 0]"
                )
                for k in range(4)
            ),
            r"lie in one plane: tilt one coil towards its normal \[-?0.00, -?0.00, -?1.00\]",
        ),
    ],
)
def test_a_mistake_in_the_coils_gets_one_line(wrong: str, complaint: str) -> None:
    text = ORBIT.replace(f"    - {COIL}", f"    - {wrong}" if wrong else "", 1)
    assert text != ORBIT
    with pytest.raises(ConfigError, match=complaint) as caught:
        reader.parse(text, "orbit.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        (
            "mass: 0.611",
            "mass: 611",
            r"`craft.mass` is 611: .* of 6.11e\+05 kg/m\^3.*: give kg and m",
        ),
        ("size: [0.1, 0.1, 0.1]", "size: [100, 100, 100]", r"`craft.mass` is 0.611: in a box of 100 x 100 x"),
        ("inertia: [1.10e-3,", "inertia: [1.0, 1.0, 1.0]  # [", r"`craft.inertia` has .* sum of 3 kg m\^2"),
        ("inertia: [1.10e-3,", "inertia: [1e-6, 1e-6, 1e-6]  # [", r"`craft.inertia` has .* sum of 3e-06 kg"),
        (
            COIL,
            "{axis: [0, 0, 1], turns: 80, area: 81, resistance: 23.0}",
            r"windings\[\d\]` has a .* of 959",
        ),
        (
            COIL,
            "{axis: [0, 0, 1], dipole_per_ampere: 0.648, resistance: 0.023}",
            r"resistance` is 0.023: .* A:",
        ),
        ("rate_noise: 2.8e-4", "rate_noise: 20", r"rate_noise` is 20: .* 0.02: .* 20 deg/s are 0.349 rad/s"),
        ("rate_noise: 2.8e-4", "angle_noise: 2", r"angle_noise` is 2: .* 2 deg are 0.0349 rad"),
        ("field_range: 2.5e-4", "field_range: 250", r"field_range` is 250: .* 250 uT are 0.00025 T"),
        (
            "field_range: 2.5e-4",
            "field_range: 1e-5",
            "is 1e-05 T; .* 6.5e-05 T: give T",
        ),
        ("mass: 0.611", "residual_dipole: [5, 0, 0]\n  mass: 0.611", "has 5 A m.2, more than 0.305 A m.2"),
    ],
)
def test_values_in_another_unit_are_refused_with_the_unit(right: str, wrong: str, complaint: str) -> None:
    assert right in ORBIT
    with pytest.raises(ConfigError, match=complaint):
        reader.parse(ORBIT.replace(right, wrong, 1), "orbit.yaml")


def test_a_rod_and_an_air_coil_have_their_own_limits_and_strengths() -> None:
    air = "{axis: [0.0, 0.0, 2.0], turns: 80, area: 0.0081, resistance: 40.0, current_limit: 0.05}"
    coils = as_orbit(reader.parse(ORBIT.replace(COIL, air, 1))).coils
    assert coils.limits == (0.148, 0.148, 0.05)
    assert coils.channels == ((0, 1), (2, 3), (4, 5))
    np.testing.assert_allclose(coils.map().dipoles, 0.648 * np.eye(3))
    np.testing.assert_allclose(coils.map().limits, 0.648 * np.array(coils.limits))


def test_the_craft_needs_its_inertia_or_its_mass() -> None:
    inertia = next(line for line in ORBIT.splitlines() if line.startswith("  inertia:"))
    box = as_orbit(reader.parse(ORBIT.replace(inertia, "", 1))).craft.inertia_matrix()
    np.testing.assert_allclose(box, 0.611 * 0.01 / 6.0 * np.eye(3))
    mass = next(line for line in ORBIT.splitlines() if line.startswith("  mass:"))
    with pytest.raises(ConfigError, match="`craft` needs `inertia` or `mass`"):
        reader.parse(ORBIT.replace(inertia, "", 1).replace(mass, "", 1))
    with pytest.raises(
        ConfigError, match=r"centre_of_mass` is 0.06 m along y: outside the box of .*: give m"
    ):
        reader.parse(ORBIT.replace(inertia, f"{inertia}\n  centre_of_mass: [0.0, 0.06, 0.0]", 1))


@pytest.mark.parametrize(
    ("name", "noise", "size", "dipole"),
    [("orbit", 3.0e-4, 1.0e-9, 3.0e-4), ("orbit_3u", 6.0e-5, 3.0e-9, 1.4e-3)],
)
def test_values_that_follow_from_craft_and_coils_are_those_tuned_for_the_shipped_satellites(
    name: str, noise: float, size: float, dipole: float
) -> None:
    config = as_orbit(reader.load(FOLDER / f"{name}.yaml"))
    estimation = reader.replace(config.estimation, torque_walk=None)
    pointing = reader.replace(config.pointing, dipole=None, slew=None)
    config = reader.replace(config, estimation=estimation, pointing=pointing)
    assert config.torque_noise() == noise
    assert config.torque_sizes() == pytest.approx((size, 2e-3 * size))
    assert config.dipole_weight() == dipole
    # At a given torque, a rigid body rotates by an angle in a time proportional to the square root of its
    # inertia.
    rows = (4.0 * config.craft.inertia_matrix()).tolist()
    heavy = reader.replace(config.craft, inertia=tuple(tuple(row) for row in rows))
    ratio = reader.replace(config, craft=heavy).slew_duration() / config.slew_duration()
    assert ratio == pytest.approx(min(2.0, 1500.0 / config.slew_duration()), rel=0.03)


def test_given_values_replace_the_computed_ones() -> None:
    config = as_orbit(reader.parse(ORBIT))
    changes = {
        "detumble": reader.replace(config.detumble, torque_noise=1e-6),
        "estimation": reader.replace(config.estimation, torque_start=2e-9, torque_walk=3e-12),
        "pointing": reader.replace(config.pointing, dipole=4e-4, slew=500.0),
    }
    config = reader.replace(config, **changes)
    assert (config.torque_noise(), config.torque_sizes()) == (1e-6, (2e-9, 3e-12))
    assert (config.dipole_weight(), config.slew_duration()) == (4e-4, 500.0)


def test_the_error_of_the_residual_dipole_follows_from_the_mass_unless_it_is_given() -> None:
    config = as_orbit(reader.parse(ORBIT))
    craft = reader.replace(config.craft, mass=2.0)
    assert reader.replace(config, craft=craft).dipole_errors() == pytest.approx((7e-3, 2.1e-3))
    # The values are the moments of inertia of a box of 3 kg with edges of 0.1, 0.2 and 0.3 m.
    inertia = tuple((0.25 * np.array([0.13, 0.10, 0.05])).tolist())
    box = reader.replace(config.craft, mass=None, size=(0.1, 0.2, 0.3), inertia=inertia)
    assert reader.replace(config, craft=box).dipole_errors()[0] == pytest.approx(1.05e-2, rel=0.05)
    accuracy = reader.replace(craft.accuracy, residual_dipole=2e-4)
    config = reader.replace(config, craft=reader.replace(craft, accuracy=accuracy))
    assert config.dipole_errors() == pytest.approx((2e-4, 2.1e-3))
    free = filter_settings(config)
    assert (free.dipole[0], free.sunlit[0]) == pytest.approx((2e-4 / 3**0.5, 2.1e-3 / 3**0.5))


def test_two_coils_leave_the_third_axis_without_a_coil() -> None:
    text = ORBIT.replace(f"    - {COIL}\n", "", 1)
    coils = as_orbit(reader.parse(text)).coils
    assert (coils.absent, coils.channels) == (frozenset({2}), ((0, 1), (2, 3), (4, 5)))
    np.testing.assert_allclose(coils.map().dipoles, np.diag([0.648, 0.648, 0.324]))
    parallel = text.replace("axis: [0.0, 1.0, 0.0], dip", "axis: [2.0, 0.0, 0.0], dip", 1)
    with pytest.raises(ConfigError, match=r"all coils lie along \[1.00, 0.00, 0.00\]: give at least one"):
        reader.parse(parallel)
    with pytest.raises(ConfigError, match="has 2 entries: the testbed has three coils"):
        reader.parse(re.sub(r"\n    - \{axis: \[0.0, 0.0, 1.0\].*", "", DEMO, count=1))


FIELD_SENSOR = "magnetometer: {max_age: 0.2, sensors: [{part: lis3mdl, measures: {magnetic: [x, y, z]}}]}\n"


@pytest.mark.parametrize("word", ["inertial_unit: none\n", ""])
def test_a_magnetometer_becomes_the_unit_of_a_file_without_an_inertial_unit(word: str) -> None:
    """Without an inertial unit, or with `inertial_unit: none`, the magnetometer takes the unit's role."""
    without = re.sub(r"(?m)^inertial_unit:.*\n(?:  .*\n)*", word, DEMO)
    config = reader.parse(without + FIELD_SENSOR)
    assert (config.inertial_unit.driver, config.inertial_unit.max_age) == ("sensors", 0.2)
    assert not config.inertial_unit.has_gyro()
    assert config.magnetometer is None
    wrong = "`inertial_unit` is none: give a `magnetometer`" if word else "inertial_unit"
    with pytest.raises(ConfigError, match=wrong):
        reader.parse(without)


def test_a_magnetometer_beside_the_inertial_unit_is_checked_like_the_unit() -> None:
    config = reader.parse(DEMO + FIELD_SENSOR)
    assert config.inertial_unit.has_gyro()
    assert config.magnetometer is not None
    assert (config.magnetometer.driver, config.magnetometer.has_gyro()) == ("sensors", False)
    assert config.hardware() != reader.parse(DEMO).hardware(), "learned parameters are not kept"
    tilted = FIELD_SENSOR.replace("max_age: 0.2", "mounting: [0.0, 0.0, 0.0, 2.0]")
    with pytest.raises(ConfigError, match=r"`magnetometer\.mounting`"):
        reader.parse(DEMO + tilted)


def test_bridges_of_which_the_last_has_no_address_are_refused() -> None:
    text = "extends: step_demo\ncoils: {driver: drv8830, address: 0x66}\n"
    assert reader.parse(text).coils.address == 0x66
    with pytest.raises(ConfigError, match=r"is 0x67: its coils use .* up to 0x69, .*: give at most 0x66"):
        reader.parse(text.replace("0x66", "0x67"))


_SENSORS = (
    "{driver: sensors, angle_noise: 1.5e-3, sensors: ["
    "{part: icm20948, address: 0x69, measures: {gyro: [x, y, z], acceleration: [x, y, z]}}, "
    "{part: lis3mdl, address: 0x1c, measures: {magnetic: [x, y, z]}}]}"
)


@pytest.mark.parametrize(
    ("base", "own"),
    [
        ("name: base", f"inertial_unit: {_SENSORS}"),
        (f"inertial_unit: {_SENSORS}", "inertial_unit: {driver: vn100}"),
        (
            "camera: {bits: 8, saturation: null, device: {driver: aravis, name: a, pixel_format: Mono8}}",
            "camera: {device: {driver: v4l2, pixel_format: GREY}}",
        ),
        (
            "camera: {bits: 8, saturation: null, device: {path: /dev/video7, pixel_format: GREY}}",
            "camera: {device: {driver: aravis, name: a, pixel_format: Mono8}}",
        ),
    ],
)
def test_keys_of_a_replaced_driver_are_neither_inherited_nor_merged(
    tmp_path: Path, base: str, own: str
) -> None:
    (tmp_path / "base.yaml").write_text(f"extends: step_demo\n{base}\n")
    text, name = f"extends: base.yaml\n{own}\n", str(tmp_path / "own.yaml")
    merged = reader.merged_text(text, name)
    assert reader.parse(merged, "merged.yaml") == reader.parse(text, name)


def test_a_misspelt_key_beside_its_driver_is_refused_in_a_file_that_extends_it(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("extends: orbit\ngps: {driver: nmea, baudrate: 9600}\n")
    with pytest.raises(ConfigError, match=r"base\.yaml:2: `gps\.baudrate` is an unknown key, did you mean"):
        reader.parse("extends: base.yaml\n", str(tmp_path / "own.yaml"))
