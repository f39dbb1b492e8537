"""Command `knightcube bringup`, which leads through the first bench session with new hardware."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import select
import sys
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from flight.app.cli.run import check_values
from flight.app.devices import emulated_bench, linux_rig, real_rig
from flight.app.run import RunRequest
from flight.app.service import requested_config, start_guardian
from flight.schema.devices import coil_fields
from flight.schema.document import config_path, to_yaml
from flight.schema.sections import Config
from ground.bringup.bench import Outcome, Session, StepSkipped
from ground.bringup.diagnosis import Finding
from ground.bringup.session import STEPS, steps_of
from ground.commands.options import CONFIG_HELP, interruptible, print_result
from knightcube.errors import UsageError
from knightcube.vision.camera.images import write_picture

FRAGMENT = "measured.yaml"
REPORT = "report.json"
PICTURE = "bringup.png"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube bringup` to the parser."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    purpose = (
        "Guide you through the first bench session with new hardware. Find each device; measure rate and "
        "noise of the inertial unit; check its axes by a turn about each body axis; drive each coil briefly, "
        "and check its sign and strength by the magnetometer and the supply current; take dark and "
        "first-light frames; show the PSF width for focusing; calibrate the lens. Each fault is reported "
        f"with its remedy. The folder keeps the results ({REPORT}), pictures, and {FRAGMENT}: the measured "
        "values as a configuration that extends CONFIG. Run the same command again to continue after the "
        "last finished step. Exit status 0: no fault; 1: faults, or steps that could not be done."
    )
    parser.description = textwrap.fill(purpose, 100)
    parser.epilog = (
        "examples:\n"
        "  knightcube bringup /etc/knightcube/flight.yaml --out bench\n"
        "  knightcube bringup /etc/knightcube/flight.yaml --out bench --only coils\n"
        "  knightcube bringup step_demo --out rehearsal        (with emulated devices)\n"
    )
    parser.add_argument("config", type=config_path, metavar="CONFIG", help=CONFIG_HELP)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="folder of the results (default: bringup)")
    parser.add_argument(
        "--only", action="append", choices=tuple(STEPS), help="repeat only this step (repeatable)"
    )
    parser.add_argument("--again", action="store_true", help="do all steps again")
    text = "emulate devices with the wiring of this configuration, which may differ from CONFIG"
    parser.add_argument("--wired", type=config_path, metavar="CONFIG2", help=text)
    parser.add_argument("--yes", action="store_true", help="do not wait for answers of the operator")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run, out=Path("bringup"))


def run(options: argparse.Namespace) -> int:
    """Execute the steps, print their results, and store them. The exit status is 1 if a fault is found."""
    text, config = requested_config(RunRequest(options.config, Path()))
    check_values(config)
    emulated = options.wired is not None or config.simulation is not None
    if not emulated and not options.yes and not sys.stdin.isatty():
        raise UsageError("the session asks a person at the bench: run it in a terminal, or give --yes")
    options.out.mkdir(parents=True, exist_ok=True)
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    kept = {} if options.again else _kept(options.out / REPORT, key)
    # A device that was missing may be connected now. Steps that were skipped without the device are not
    # stored.
    if "find" in kept and kept["find"].findings:
        del kept["find"]
    wanted = options.only or [name for name in steps_of(config) if name not in kept]
    # After Ctrl-C the coils are set to zero before the program ends.
    with interruptible(), _opened(options, text, config, emulated) as session:
        session.known |= kept
        for name in wanted:
            try:
                outcome = STEPS[name](session)
            except StepSkipped as reason:
                found = [] if reason.finding is None else [reason.finding]
                outcome = Outcome(found, {"skipped": str(reason)})
            outcome.findings.extend(session.lost_guardians())
            session.known[name] = outcome
            _keep(options, key, session.known, name)
            if not options.json:
                sys.stdout.write(_step_text(name, outcome))
    from ground.report.figures import draw_bench  # noqa: PLC0415 - loads matplotlib

    ordered = {name: session.known[name] for name in STEPS if name in session.known}
    frames = {title: options.out / f"{title}.png" for title in ("dark", "light", "focus")}
    kept_frames = {title: path for title, path in frames.items() if path.exists()}
    draw_bench(options.out / PICTURE, ordered, kept_frames)
    findings = [finding for outcome in ordered.values() for finding in outcome.findings]
    reasons = [str(one.values["skipped"]) for one in ordered.values() if "skipped" in one.values]
    facts = {"steps": {name: _facts(one) for name, one in ordered.items()}, "faults": len(findings)}
    missed = f", {len(reasons)} steps skipped" if reasons else ""
    files = f"{options.out / FRAGMENT}, {options.out / PICTURE}"
    print_result(options, facts, f"{'verdict':8}{len(findings)} faults{missed}; {files}\n")
    # A step whose device is not configured may be skipped.
    undone = any(not reason.startswith("the configuration has no") for reason in reasons)
    return 1 if findings or undone else 0


@contextmanager
def _opened(options: argparse.Namespace, text: str, config: Config, emulated: bool) -> Iterator[Session]:
    """Open the real or emulated devices, and close them with the coils at zero. Raises DeviceError."""

    def ask(request: str) -> None:
        if emulated or options.yes:
            return
        sys.stderr.write(f"{request} Then press Enter. ")
        sys.stderr.flush()
        if not sys.stdin.readline():
            raise UsageError("the terminal was closed: the finished steps are kept")

    def live(measured: str) -> bool:
        sys.stderr.write(f"\r{measured} (Enter: done) ")
        sys.stderr.flush()
        done = bool(select.select([sys.stdin], [], [], 0.0)[0])
        if done:
            sys.stdin.readline()
        return not done

    with ExitStack() as stack:
        if emulated:
            wired = options.wired or options.config
            wired_text, wired_config = requested_config(RunRequest(wired, Path()))
            bench = emulated_bench(wired, wired_text, wired_config)
            session = Session(config, bench.rig, stack, ask, bench)
        else:
            # A missing chip is reported as a finding and does not end the session.
            rig = linux_rig(config, stack, patient=True)
            guardian = start_guardian(rig, stack)
            if guardian is not None:
                guardian.wait_ready(patient=True)
            rig = replace(rig, wires=real_rig(config, stack).wires)
            session = Session(config, rig, stack, ask, None, guardian, live=None if options.yes else live)
        given = _coil_field(options.config, text, config)
        session.coil_field = None if given is None else given[: len(config.coils.windings)]
        try:
            yield session
        finally:
            session.close()


def _coil_field(path: Path, text: str, config: Config) -> Any:
    """Return the field of each coil (n, 3), T/A, from the configuration, or None if it is not configured."""
    rows = None
    if config.simulation is not None:
        from sim_hal.rig import SimulationRequest  # noqa: PLC0415 - loads the simulator

        rows = SimulationRequest(path, text, Path()).section().coil_field
    return coil_fields(config) if rows is None else np.array(rows).T


# Stored results.


def _kept(path: Path, key: str) -> dict[str, Outcome]:
    """Return the outcomes of earlier steps with the same configuration. Raises UsageError."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        steps = {name: one for name, one in stored["steps"].items() if name in STEPS and one["config"] == key}
        return {name: _restored(path.parent, name, one) for name, one in steps.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, BadZipFile) as error:
        raise UsageError(f"{path}: cannot be read ({error}): give --again, or another --out") from error


def _restored(folder: Path, name: str, stored: dict[str, Any]) -> Outcome:
    findings = [Finding(**one) for one in stored["findings"]]
    arrays: dict[str, Any] = {}
    file = folder / f"{name}.npz"
    if file.exists():
        with file.open("rb") as opened, np.load(opened) as kept:
            arrays = {key: kept[key] for key in kept.files}
    return Outcome(findings, stored["values"], stored["changes"], arrays)


def _facts(outcome: Outcome) -> dict[str, Any]:
    return {
        "findings": [asdict(finding) for finding in outcome.findings],
        "values": outcome.values,
        "changes": outcome.changes,
    }


def _keep(options: argparse.Namespace, key: str, known: Mapping[str, Outcome], name: str) -> None:
    """Write the results so far, so that an interrupted session loses only the step in progress."""
    folder, outcome = options.out, known[name]
    if outcome.arrays:
        np.savez(folder / f"{name}.npz", **outcome.arrays)
    else:  # the file of an earlier session does not belong to this outcome
        (folder / f"{name}.npz").unlink(missing_ok=True)
    for title, pixels in outcome.frames.items():
        write_picture(folder / f"{title}.png", pixels)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        stored = json.loads((folder / REPORT).read_text(encoding="utf-8"))["steps"]
    except (OSError, ValueError, KeyError):
        stored = {}
    stored = {step: one for step, one in stored.items() if step in known and one.get("config") == key}
    if "skipped" in outcome.values:
        stored.pop(name, None)  # a skipped step is not stored, so a later session tries it again
    else:
        stored[name] = {"config": key, "done": now, **_facts(outcome)}
    _write(folder / REPORT, json.dumps({"config": str(options.config), "steps": stored}, indent=1) + "\n")
    changes: dict[str, Any] = {}
    for step in STEPS:
        for section, values in (known[step].changes if step in known else {}).items():
            changes.setdefault(section, {}).update(values)
    head = f"# Measured by `knightcube bringup {options.config}` on {now}.\n"
    _write(folder / FRAGMENT, head + to_yaml({"extends": str(options.config.resolve()), **changes}))


def _write(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.new")
    beside.write_text(text, encoding="utf-8")
    os.replace(beside, path)


def _step_text(name: str, outcome: Outcome) -> str:
    faulty = {finding.part for finding in outcome.findings}
    if "skipped" in outcome.values:
        lines = [f"{name:8}skipped: {outcome.values['skipped']}"]
    elif name == "find":
        lines = [
            f"{name:8}{'FAULT' if part in faulty else 'ok':6}{part} on {answer}"
            for part, answer in outcome.values["answers"].items()
        ]
    else:
        lines = [f"{name:8}{'FAULT' if faulty else 'ok':6}{_measured(name, outcome.values)}"]
    return "\n".join([*lines, *(f"{'':8}{finding.line()}" for finding in outcome.findings)]) + "\n"


_FORMATS = {
    "gps": "{fixes} fixes, {satellites} satellites",
    "dark": "level {level:.0f} counts, read noise {read_noise:.1f} e-",
    "light": "{sources} point sources, level {level:.0f} counts",
    "focus": "PSF width {psf_sigma:.2f} px (standard deviation)",
    "lens": "field of view {field_of_view_deg:.3f} deg, {stars} stars, residual {rms_px:.3f} px",
}


def _measured(name: str, values: Mapping[str, Any]) -> str:
    match name:
        case "rest" if "noise" not in values:
            text = f"{values['samples']} samples"
        case "rest":
            noise, expected = {key: max(one) for key, one in values["noise"].items()}, values["expected"]
            text = (
                f"{values['rate_hz']:.2f} samples/s; noise (expected) "
                f"{noise['gyro']:.2g} ({expected['gyro']:.2g}) rad/s, "
                f"{1e9 * noise['field']:.0f} ({1e9 * expected['field']:.0f}) nT, "
                f"{noise['acceleration']:.2g} ({expected['acceleration']:.2g}) m/s^2"
            )
        case "axes":
            sizes = [f"{np.linalg.norm(turn):.0f}" for turn in values["turns_deg"]]
            turns = ", ".join(f"{axis} {size}" for axis, size in zip("xyz", sizes, strict=True))
            text = f"rotations of 90 deg, measured by the gyro: {turns} deg"
        case "coils":
            fields = ", ".join(f"{value:+.2f}" for value in values["strength"])
            drawn = ("-" if None in row else f"{500.0 * sum(row):.0f}" for row in values["current"])
            text = f"fields relative to the expected ones {fields}; supply current {', '.join(drawn)} mA"
        case "power":
            form = "{} {voltage:.2f} V, {current:.3f} A, with a coil {milliamperes:+.0f} mA"
            monitors = values["monitors"].items()
            text = ", ".join(form.format(key, **one, milliamperes=1e3 * one["rise"]) for key, one in monitors)
        case "strings":
            lit = ", ".join(f"{1e3 * row[number]:.0f}" for number, row in enumerate(values["currents"]))
            text = f"currents in the light of a lamp {lit} mA"
        case "wide":
            text = f"mean levels {', '.join(f'{level:.0f}' for level in values['levels'].values())} counts"
        case _:
            text = _FORMATS[name].format(**values)
    return text
