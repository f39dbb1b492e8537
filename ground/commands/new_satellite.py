"""Command `knightcube new-satellite`, which writes the configuration of a satellite."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from flight.app.cli import PROGRAM
from flight.app.devices import check_settings, check_simulated_elements
from flight.app.run import RunRequest
from flight.schema import reader as configuration
from flight.schema.document import ConfigError
from ground import satellite_description as description
from ground.commands.elements import elements_of
from ground.commands.options import interruptible, print_result, write_new
from ground.satellite_description import Derived, Question, Satellite, Values
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.errors import UsageError, reason_of
from sim_hal.settings import OrbitSection
from sim_hal.worlds.orbit import julian_date

_WEAK = 3.0
"""Smallest ratio of the coils' torque to the worst disturbance torque for which no warning is printed."""

_LOW_INCLINATION = 10.0
"""Smallest inclination (deg) without a warning. At 0 deg, a simulated 3U held nadir within 19 deg rms."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube new-satellite` to the parser."""
    parser.description = textwrap.fill(
        "Write the configuration of a satellite, which `knightcube check` and `knightcube run` accept. On a "
        "terminal, the values that are not given are asked for, and an empty answer takes the value in "
        "brackets. The inertia is that of a homogeneous cuboid, two-line elements are fitted to the orbit, "
        "and mountings and limits are computed. The file extends the configuration `orbit` and states the "
        "source of each value."
    )
    parser.epilog = (
        "examples:\n"
        f"  {PROGRAM} new-satellite\n"
        f"  {PROGRAM} new-satellite --mass 4 --size 3u --altitude 550 --coil {description.COIL_EXAMPLE}\n"
        f"  {PROGRAM} new-satellite --mass 8 --size 6u --inclination 51.6 --out six.yaml \\\n"
        "    --coil axis=xy,dipole=0.5,current=0.1,resistance=50 \\\n"
        "    --coil axis=z,turns=200,area=0.02,resistance=33,current=0.12"
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    for question in description.QUESTIONS:
        repeated = question.name == "coil"
        default = f"default {question.default}" if question.default is not None else "required"
        parser.add_argument(
            f"--{question.name}",
            action="append" if repeated else "store",
            metavar=question.metavar,
            help=f"{question.text} ({default}{'; repeatable' if repeated else ''})",
        )
    parser.add_argument("--out", type=Path, metavar="FILE", help="file to write (default NAME.yaml)")
    parser.add_argument("--force", action="store_true", help="replace the file if it exists")
    parser.add_argument("--json", action="store_true", help="print one JSON object without asking questions")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Complete the description, write the configuration and print the computed values."""
    answers = Answers(options.out, options.force)
    answers.take_options(options)
    missing = answers.missing()
    if not missing:
        answers.take_defaults()
    elif options.json or not sys.stdin.isatty():
        verb = "is" if len(missing) == 1 else "are"
        raise UsageError(f"{', '.join(missing)} {verb} missing; on a terminal the command asks for values")
    else:
        with interruptible():
            answers.ask()
    try:
        facts, text = _written(answers, options.force)
    except UsageError:
        if missing:
            sys.stderr.write(f"knightcube: the answers as a command:\n  {answers.command()}\n")
        raise
    print_result(options, facts, text)
    return 0


def _written(answers: Answers, force: bool) -> tuple[dict[str, Any], str]:
    """Write the file, and return the result as values for `--json` and as text. Raises UsageError."""
    path, satellite = answers.path(), satellite_of(answers.values)
    date = julian_date(satellite.utc)
    values, made = description.derived(satellite, date), elements_of(satellite.orbit, date)
    text = description.configuration_text(satellite, values, made, answers.command())
    _check(text, path)
    if force:
        _replace(path, text)
    else:
        write_new(path, text)
    facts = {
        "file": str(path),
        "command": answers.command(),
        "elements": list(made.lines),
        "inclination_deg": satellite.orbit.inclination_deg,
        "derived": asdict(values),
        "warnings": warnings_of(satellite, values),
    }
    return facts, _text(satellite, values, path)


class Answers:
    """The values of the satellite's description, and the texts that the user entered for them."""

    def __init__(self, out: Path | None, force: bool) -> None:
        """Set the file to write, if given, and allow replacing an existing file if `force` is true."""
        self._out, self._force = out, force
        self._texts: dict[str, list[str]] = {}
        self.values: dict[str, Any] = {}

    def take_options(self, options: argparse.Namespace) -> None:
        """Store the given options. Raises UsageError for an impossible value, and if the file exists."""
        for question in description.QUESTIONS:
            given = getattr(options, question.name.replace("-", "_"))
            if given is not None:
                self._take(question, given if isinstance(given, list) else [given])
        if self._out is not None or "name" in self._texts:
            self.path()

    def missing(self) -> list[str]:
        """Return the required options that the user has not given."""
        return [
            f"--{one.name}"
            for one in description.QUESTIONS
            if one.default is None and one.name not in self.values
        ]

    def take_defaults(self) -> None:
        """Set each value that the user has not given to its default.

        Raises UsageError if a default contradicts a given value.
        """
        for question in self._open():
            if question.default is not None:
                self._take(question, [question.default])

    def path(self) -> Path:
        """Return the file to write.

        Raises UsageError if the file exists and may not be replaced.
        """
        path = self._out or Path(f"{self.values.get('name', description.QUESTIONS[0].default)}.yaml")
        if not self._force and os.path.lexists(path):
            raise UsageError(f"{path}: this file exists: give another --out, or --force to replace it")
        return path

    def command(self) -> str:
        """Return the command line with the values that are known so far."""
        words = [PROGRAM, "new-satellite"]
        for name, texts in self._texts.items():
            for text in texts:
                words += [f"--{name}", shlex.quote(text)]
        return " ".join([*words, *(["--out", shlex.quote(str(self._out))] if self._out is not None else [])])

    def ask(self) -> None:
        """Ask for the values that the user has not given as options.

        Raises KeyboardInterrupt after Ctrl-C, and UsageError at the end of the input. In both cases, a
        command line is shown that continues after the answers so far.
        """
        try:
            for question in self._open():
                self._ask(question)
        except KeyboardInterrupt:
            sys.stderr.write(f"\nknightcube: nothing was written; to continue:\n  {self.command()}\n")
            raise
        except EOFError:
            raise UsageError(f"the input has ended; to continue: {self.command()}") from None

    def _open(self) -> Iterator[Question]:
        yield from (question for question in description.QUESTIONS if question.name not in self.values)

    def _ask(self, question: Question) -> None:
        """Ask until an answer is accepted. Raises EOFError at the end of the input."""
        default, coils = question.default, question.name == "coil"
        several = "; spaces between different coils" if coils else ""
        while True:
            sys.stderr.write(f"{question.text}{several}{'' if default is None else f' [{default}]'}: ")
            sys.stderr.flush()
            line = sys.stdin.readline()
            if not line:
                raise EOFError
            if not (answer := line.strip() or default):
                sys.stderr.write("  this value has no default: give one\n")
                continue
            try:
                return self._take(question, answer.split() if coils else [answer])
            except UsageError as error:
                sys.stderr.write(f"  {error}\n")

    def _take(self, question: Question, texts: list[str]) -> None:
        """Read the value of a question from the answer's words, and store it. Raises UsageError."""
        name = question.name
        if name == "eccentricity" and name in self.values:
            raise UsageError(f"--{name} {texts[-1]}: --altitude has perigee and apogee: omit this option")
        found: dict[str, Any] = {}
        for text in texts:
            value = description.read_value(name, text)
            if isinstance(value, description.Apsides):
                found = asdict(value)
            else:
                found[name] = [*found.get(name, ()), *value] if name == "coil" else value
        try:
            self.values |= found
            description.check_values(name, self.values)
        except UsageError as error:
            for one in found:
                del self.values[one]
            raise UsageError(f"--{name} {' '.join(texts)}: {error}") from error
        self._texts[name] = texts


def satellite_of(values: Values) -> Satellite:
    """Return the satellite that the values describe; no value may be missing. Raises UsageError."""
    altitude, eccentricity = 1e3 * values["altitude"], values["eccentricity"]
    inclination = values["inclination"]
    if inclination is None:
        inclination = description.sun_synchronous_inclination(altitude, eccentricity)
    orbit = {"altitude": altitude, "eccentricity": eccentricity, "inclination_deg": inclination}
    orbit["local_time"] = values["local-time"]
    coils = tuple(values["coil"])
    try:
        section = msgspec.convert(orbit, OrbitSection)
    except msgspec.ValidationError as error:
        raise UsageError(f"this orbit is not supported: {error}") from error
    return Satellite(
        name=values["name"],
        mass=values["mass"],
        size=values["size"],
        orbit=section,
        utc=values["utc"],
        coils=coils,
        supply_voltage=max(coil.resistance * coil.current_limit for coil in coils),
        field_of_view_deg=values["star-camera"],
        wide_cameras=values["horizon-cameras"],
        release_deg=values["release"],
    )


def _check(text: str, path: Path) -> None:
    """Check a configuration text as `knightcube check` does, without flying it. Raises UsageError."""
    try:
        config = configuration.parse(text, str(path))
        check_settings(config)
        check_simulated_elements(RunRequest(path, Path()), text, config)
    except ConfigError as error:  # the message omits the line number, because the file does not exist yet
        raise UsageError(f"nothing was written: {error.problem}") from error


def _replace(path: Path, text: str) -> None:
    """Write a file, which replaces an existing file only when it is complete. Raises UsageError."""
    beside = path.with_name(f".{path.name}.new")
    try:
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise UsageError(f"{path}: cannot be written: {reason_of(error)}") from error


def warnings_of(satellite: Satellite, values: Derived) -> list[str]:
    """Return warnings about weak coils, and about an orbit in which the coils cannot point in all axes."""
    found = []
    inclination = satellite.orbit.inclination_deg
    if min(inclination, 180.0 - inclination) < _LOW_INCLINATION:
        field = (
            f"at an inclination of {inclination:g} deg the magnetic field is nearly along the orbit normal"
        )
        found.append(f"{field}, so the coils have little torque about it: simulate pointing for a revolution")
    ratio = values.coil_torque / values.disturbance
    if ratio < _WEAK:
        torque = f"the coils' torque is {ratio:.2g} times the largest disturbance torque"
        found.append(f"{torque}, so pointing may fail: use stronger coils or a higher orbit")
    if values.momentum_time > values.period:
        hours = values.momentum_time / 3600.0
        found.append(f"detumbling takes more than {hours:.1f} h: use stronger coils, or a smaller --release")
    return found


def _text(satellite: Satellite, values: Derived, path: Path) -> str:
    moments = ", ".join(f"{moment:.3g}" for moment in values.inertia)
    orbit, config = satellite.orbit, shlex.quote(str(path))
    ratio = values.coil_torque / values.disturbance
    perigee, apogee = (
        (EARTH_RADIUS + orbit.altitude) * (1.0 + sign * orbit.eccentricity) - EARTH_RADIUS
        for sign in (-1.0, 1.0)
    )
    shape = f"{1e-3 * perigee:.0f} to {1e-3 * apogee:.0f} km, {orbit.inclination_deg:.2f} deg"
    torque = f"{values.dipole:.3g} A m^2; {values.coil_torque:.2g} N m, {ratio:.3g} times the largest"
    lines = [
        ("written", str(path)),
        ("inertia", f"{moments} kg m^2, of a homogeneous cuboid"),
        ("orbit", f"{shape}, {values.period / 60.0:.1f} min"),
        ("coils", f"{torque} aerodynamic and solar radiation torque"),
        ("detumbling", f"from {satellite.release_deg:g} deg/s within about {values.slow_within:g} s"),
        *(("warning", text) for text in warnings_of(satellite, values)),
        ("next", f"{PROGRAM} check {config}"),
        ("", f"{PROGRAM} run {config} --out runs/{satellite.name}"),
        ("", f"{PROGRAM} report runs/{satellite.name}"),
    ]
    return "".join(f"{name + ':' if name else '':12}{text}\n" for name, text in lines)
