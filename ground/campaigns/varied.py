"""Campaign of flights with configuration values drawn at random from given distributions, and its plot."""

from __future__ import annotations

import copy
import difflib
import math
import re
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from flight.app.flight import fly
from flight.app.run import RunRequest
from flight.schema import reader as configuration
from flight.schema.document import read_document, read_text, to_yaml
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from ground.report import drawing, summarise
from ground.telemetry import read_run
from hal.interfaces.errors import DeviceError
from knightcube.astro.arrays import FloatArray
from knightcube.errors import KnightCubeError, UsageError
from sim_hal.settings import Simulation

_DRAWS = 100
"""Maximum number of draws per case.

A draw is repeated if its configuration is invalid, for example because of an impossible inertia.
"""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_FORMS = (
    "KEY=10% (uniform, relative), KEY=+-0.5 (uniform), KEY=normal 10% or KEY=normal 0.5 (standard "
    "deviation), KEY=1..5 (uniform), KEY=log 1..100 (uniform in the logarithm) or KEY=a|b|c (one of these)"
)
_MOST_LISTED = 20  # maximum number of failed flights in the printed table (all are in the file summary.json)

Draw = Callable[[np.random.Generator, float], Any]


@dataclass(frozen=True, slots=True)
class Variation:
    """Configuration value that is drawn at random for each flight.

    Attributes:
        key: dotted key of the configuration, such as `craft.inertia` or `targets[0].at`.
        text: text of the distribution as given by the user.
        draw: function that returns the drawn value, given a random generator and the configured number.
        relative: whether the drawn value depends on the configured number.
        choices: the values of a distribution `a|b|c`; empty for other distributions.
    """

    key: str
    text: str
    draw: Draw
    relative: bool
    choices: tuple[Any, ...] = ()


def variation_of(text: str) -> Variation:
    """Return the variation in a text such as `craft.inertia=10%`. Raises UsageError for an invalid text."""
    key, equals, spread = (part.strip() for part in text.partition("="))
    if not equals or not re.fullmatch(r"\w+(\.\w+|\[\d+\])*", key):
        raise UsageError(f"--vary {text!r}: give {_FORMS}")
    if "|" in spread:
        scalars = (read_document(f"value: {one.strip()}\n", "value") for one in spread.split("|"))
        values = tuple(scalar.values["value"] for scalar in scalars)
        return Variation(
            key, spread, lambda chance, _: values[int(chance.integers(len(values)))], False, values
        )
    found = _distribution(spread)
    if found is None:
        wrong = "has its limits in the wrong order, or a limit of 0" if ".." in spread else "is not known"
        raise UsageError(f"--vary {text!r}: the distribution {spread!r} {wrong}: give {_FORMS}")
    return Variation(key, spread, *found)


def _distribution(spread: str) -> tuple[Draw, bool] | None:
    """Return sampling function (`draw`) and flag `relative` of a variation, or None for an invalid text."""
    if found := re.fullmatch(rf"(log )?({_NUMBER})\.\.({_NUMBER})", spread):
        low, high = float(found[2]), float(found[3])
        return None if not low < high or (found[1] and low <= 0.0) else _between(low, high, bool(found[1]))
    found = re.fullmatch(rf"(normal |\+-)?({_NUMBER})(%)?", spread)
    if not found or not (found[1] or found[3]) or float(found[2]) < 0.0:
        return None
    size, relative = float(found[2]) * (0.01 if found[3] else 1.0), bool(found[3])

    def around(chance: np.random.Generator, value: float) -> float:
        step = float(chance.standard_normal() if found[1] == "normal " else chance.uniform(-1.0, 1.0))
        return value + size * step * (abs(value) if relative else 1.0)

    return around, True


def _between(low: float, high: float, logarithmic: bool) -> tuple[Draw, bool]:
    if logarithmic:
        ends = math.log(low), math.log(high)
        return (lambda chance, _: math.exp(chance.uniform(*ends))), False
    return (lambda chance, _: float(chance.uniform(low, high))), False


def varied_campaign(path: Path, variations: Sequence[Variation], duration: float | None) -> Campaign:
    """Return the Monte Carlo campaign of a simulated configuration with random parameters.

    The result of a flight contains its random parameters and those performance measures that have a limit.
    The limits are those of the section `requirements` for a satellite, and those of the thesis for a testbed.
    Case k does not depend on the number of runs. Each flight lasts `duration` s, or as configured if
    `duration` is None. Raises UsageError for a key or a distribution that the configuration does not allow.
    """
    text = read_text(path)
    base = read_document(text, str(path)).values
    if "simulation" not in base:
        raise UsageError(f"{path}: has no section `simulation`; a campaign needs one, add it")
    keys = [one.key for one in variations]
    for one in variations:
        if keys.count(one.key) > 1:
            raise UsageError(f"--vary {one.key}: is given {keys.count(one.key)} times: give one distribution")
        if one.key == "simulation.seed":
            raise UsageError("--vary simulation.seed: each flight has its own seed; --seed changes all seeds")
        _numbers_at(base, one)
        for value in one.choices:
            # Raises UsageError for a value that the configuration check always refuses.
            only = [_fixed(each, value) if each is one else each for each in variations]
            _case(base, only, duration, (0, 0))

    def cases(runs: int, seed: int) -> list[Case]:
        return [_case(base, variations, duration, (seed, number)) for number in range(runs)]

    words = ", ".join(f"{one.key}={one.text}" for one in variations)
    crc = zlib.crc32(to_yaml(base).encode())
    length = "" if duration is None else f", {duration:g} s"
    name = f"{path.stem} with {words}{length} (CRC {crc:08x})"
    return Campaign(name, "flights with drawn values", cases, fly_case, _summarise, 100)


def _fixed(one: Variation, value: Any) -> Variation:
    """Return a variation that always draws the same value."""

    def draw(chance: np.random.Generator, configured: float) -> Any:
        return value

    return replace(one, draw=draw)


def _case(
    base: dict[str, Any], variations: Sequence[Variation], duration: float | None, seed: tuple[int, int]
) -> Case:
    """Return the case of a seed, with the complete configuration as text and its random values by key."""
    chance = np.random.default_rng(seed)
    refusal = ""
    drawn: dict[str, Any] = {}
    for refused in range(_DRAWS):
        values = copy.deepcopy(base)
        drawn = {}
        for one in variations:
            drawn |= _drawn(values, one, chance)
        text = to_yaml(values)
        try:
            configuration.parse(text, "drawn values")
            configuration.simulation_section(text, "drawn values", Simulation)
        except KnightCubeError as error:
            refusal = str(error)
            continue
        parameters = {"config": text, "drawn": drawn, "duration": duration, "refused": refused}
        parameters["seed"] = int(chance.integers(2**31))
        return Case(f"flight-{seed[1]:05d}", seed, parameters)
    shown = ", ".join(f"{key} = {value}" for key, value in drawn.items())
    raise UsageError(f"--vary: each of {_DRAWS} draws is refused, such as {shown}: {refusal}")


def _numbers_at(values: dict[str, Any], one: Variation) -> list[tuple[Any, Any, str]]:
    """Return container, index and full key of each number to draw at random. Raises UsageError."""
    steps = [int(step) if step.isdigit() else step for step in re.findall(r"\w+", one.key)]
    holder: Any = values
    for depth, step in enumerate(steps[:-1]):
        holder = _below(holder, step, one, steps[: depth + 1])
    last = steps[-1]
    if isinstance(holder, dict) and last not in holder and not one.relative:
        # The random value replaces a default value that the configuration does not state.
        return [(holder, last, one.key)]
    found = _below(holder, last, one, steps)
    if not one.relative and not isinstance(found, list):
        return [(holder, last, one.key)]
    numbers = list(_leaves(holder, last, one.key))
    if not numbers or (one.relative and not all(_is_number(holder[at]) for holder, at, _ in numbers)):
        raise UsageError(f"--vary {one.key}={one.text}: the configured value {found!r} is not a number")
    return numbers


def _below(holder: Any, step: Any, one: Variation, path: Sequence[Any]) -> Any:
    """Return the item `step` of a container. Raises UsageError, with similar keys, if it is missing."""
    if isinstance(holder, dict) and step in holder:
        return holder[step]
    if isinstance(holder, list) and isinstance(step, int) and step < len(holder):
        return holder[step]
    names = [str(name) for name in holder] if isinstance(holder, dict) else []
    near = difflib.get_close_matches(str(step), names, 3) or names
    cure = f"one of {', '.join(near)}" if near else "a range such as 1..5, which needs no configured value"
    place = ".".join(map(str, path))
    raise UsageError(f"--vary {one.key}={one.text}: the configuration has no value {place}: give {cure}")


def _leaves(holder: Any, at: Any, key: str) -> Iterator[tuple[Any, Any, str]]:
    """Yield container, index in the container, and full key of each value in nested lists."""
    if isinstance(holder[at], list):
        for number in range(len(holder[at])):
            yield from _leaves(holder[at], number, f"{key}[{number}]")
    else:
        yield holder, at, key


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _drawn(values: dict[str, Any], one: Variation, chance: np.random.Generator) -> dict[str, Any]:
    """Replace the configured numbers of a variation by random values, and return these values by full key."""
    drawn = {}
    for holder, at, key in _numbers_at(values, one):
        held = holder[at] if isinstance(holder, list) or at in holder else math.nan
        holder[at] = drawn[key] = one.draw(chance, float(held) if _is_number(held) else math.nan)
    return drawn


def fly_case(case: Case) -> Result:
    """Fly a case in lock-step, and return its random parameters and the performance measures with limits."""
    given = case.parameters
    found: Result = {"key": case.key, "drawn": given["drawn"], "judged": [], "error": ""}
    found |= {name: given[name] for name in ("seed", "duration")}
    found |= {"refused": given["refused"]} if given.get("refused") else {}
    with tempfile.TemporaryDirectory(prefix="knightcube-") as place:
        config = Path(place) / f"{case.key}.yaml"
        config.write_text(given["config"], encoding="utf-8")
        run, duration, seed = Path(place) / "run", given["duration"], given["seed"]
        request = RunRequest(config, run, duration=duration, seed=seed, trial=True)
        try:
            flown = fly(request)
            report = summarise(read_run(request.out))
        except (KnightCubeError, DeviceError) as error:
            # The configuration is kept as `failed/KEY.yaml`; the temporary file of the message is deleted.
            return found | {"error": str(error).replace(f"{place}/", ""), "config": given["config"]}
    if flown.interrupted:  # Ctrl-C also reaches the worker processes
        raise KeyboardInterrupt
    found["mode"] = flown.ending.mode
    found["faults"] = dict(flown.ending.faults)
    found["judged"] = [
        {"quantity": re.sub(r"pointing to .*, rms", "pointing, rms", row["quantity"]), **rest}
        for row in (*report["requirements"], *report["thesis"])
        for rest in [{key: row[key] for key in ("worst", "limit", "unit", "verdict")}]
    ]
    return found if _within(found) else found | {"config": given["config"]}


def _within(result: Result) -> bool:
    """Return whether a flight ended without an error and satisfied every limit."""
    return not result["error"] and all(row["verdict"] != "miss" for row in result["judged"])


def figures_of(results: Sequence[Result]) -> dict[str, tuple[float, str, list[float]]]:
    """Return limit, unit and worst value per flight (NaN if unknown) of each quantity with a limit."""
    found: dict[str, tuple[float, str, list[float]]] = {}
    for number, result in enumerate(results):
        for row in result["judged"]:
            _, _, values = found.setdefault(
                row["quantity"], (row["limit"], row["unit"], [math.nan] * len(results))
            )
            worst = math.nan if row["worst"] is None else float(row["worst"])
            values[number] = float(np.fmax(worst, values[number]))  # the larger value, ignoring NaN
    return found


def numbers_drawn(results: Sequence[Result]) -> dict[str, list[float]]:
    """Return the random numbers of all flights by key; parameters with values of other kinds are omitted."""
    drawn = [result["drawn"] for result in results]
    keys = [key for key in drawn[0] if all(_is_number(one[key]) for one in drawn)]
    return {key: [float(result["drawn"][key]) for result in results] for key in keys}


def _summarise(results: Sequence[Result], out: Path) -> Summary:
    """Return the summary of a campaign, and write the configurations of failed flights."""
    failed = [result for result in results if not _within(result)]
    folder = out / "failed"
    for result in failed:
        folder.mkdir(exist_ok=True)
        (folder / f"{result['key']}.yaml").write_text(result["config"], encoding="utf-8")
    drawn, figures = numbers_drawn(results), figures_of(results)
    facts: dict[str, Any] = {
        "flights": len(results),
        "within all limits": len(results) - len(failed),
        "draws that the configuration check refused": sum(result.get("refused", 0) for result in results),
        "figures": [
            {
                "figure": name,
                "unit": unit,
                "limit": limit,
                "n": int(np.isfinite(values).sum()),
                "within": int(np.sum(np.array(values) <= limit)),
                **_quantiles(values),
                "strongest influence": _influence(drawn, values),
            }
            for name, (limit, unit, values) in figures.items()
        ],
        "failed flights": [
            {"flight": result["key"], "why": _why(result), "fly it again": _again(result, folder)}
            for result in failed
        ],
    }
    short = facts | {"failed flights": facts["failed flights"][:_MOST_LISTED]}
    if len(failed) > _MOST_LISTED:
        short["further failed flights, in summary.json"] = len(failed) - _MOST_LISTED
    for name in ("failed flights", "draws that the configuration check refused"):
        if not short[name]:
            del short[name]
    return Summary(summary(short).text, facts)


def _quantiles(values: Sequence[float]) -> dict[str, float | None]:
    known = [value for value in values if math.isfinite(value)]
    found = [np.median(known), np.quantile(known, 0.95), np.max(known)] if known else []
    return dict(zip_longest(("median", "95 %", "maximum"), map(float, found)))


def _influence(drawn: dict[str, list[float]], values: Sequence[float]) -> str:
    """Return the key of the random parameter that correlates most with `values`, and the rank correlation."""
    known = np.isfinite(values)
    ranks = _ranks(np.array(values)[known])
    best = ("", 0.0)
    for key, numbers in drawn.items():
        own = _ranks(np.array(numbers)[known])
        if len(ranks) > 2 and np.ptp(ranks) and np.ptp(own):
            correlation = float(np.corrcoef(ranks, own)[0, 1])
            best = max(best, (key, correlation), key=lambda pair: abs(pair[1]))
    return f"{best[0]} {best[1]:+.2f}" if best[0] else "-"


def _ranks(values: FloatArray) -> FloatArray:
    """Return the ranks (n,) of values (n,), where equal values have their mean rank."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * (counts - 1))[places])


def _why(result: Result) -> str:
    if result["error"]:
        return str(result["error"])
    missed = []
    for row in result["judged"]:
        if row["verdict"] == "miss":
            worst = "none" if row["worst"] is None else f"{row['worst']:.3g} {row['unit']}"
            missed.append(f"{row['quantity']} {worst} (limit {row['limit']:g})")
    return "; ".join(missed)


def _again(result: Result, folder: Path) -> str:
    length = "" if result["duration"] is None else f" --duration {result['duration']:g}"
    return f"knightcube run {folder / result['key']}.yaml --seed {result['seed']}{length}"


_LABEL = 22  # maximum number of characters in a line of an axis label
_MOST = 6  # maximum number of rows and of columns of panels in the plot


def draw_campaign(results: Sequence[Result], file: Path) -> bool:
    """Plot the performance measures of all flights against the random parameters, as a PNG.

    Returns False and writes no file if the results have no performance measures or no random parameters. At
    most six measures are plotted against at most six parameters. Crosses mark flights beyond the limit of a
    measure; infinite measures are at the upper edge. Raises UsageError if matplotlib is not installed or the
    file cannot be written.
    """
    drawn = list(numbers_drawn(results).items())[:_MOST]
    figures = [one for one in figures_of(results).items() if np.any(np.isfinite(one[1][2]))][:_MOST]
    if not (drawn and figures):
        return False
    with drawing(file):
        from matplotlib.figure import Figure  # noqa: PLC0415 - an extra
        from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

        from ground.report import panels  # noqa: PLC0415
        from ground.report.figures import save  # noqa: PLC0415

        size = (2.0 + 3.2 * len(drawn), 0.8 + 2.4 * len(figures))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(figures), len(drawn), squeeze=False, sharex="col", sharey="row")
        for row, (name, (limit, unit, listed)) in enumerate(figures):
            values = np.array(listed)
            for axes, (key, numbers) in zip(grid[row], drawn, strict=True):
                chosen = np.array(numbers)
                good = values <= limit
                beyond = np.isfinite(values) & ~good
                axes.plot(chosen[good], values[good], ".", color=panels.BLUE, markersize=5)
                axes.plot(chosen[beyond], values[beyond], "x", color=panels.VERMILLION, markersize=6)
                infinite = chosen[np.isinf(values)]
                if len(infinite):
                    edge = axes.get_xaxis_transform()
                    axes.plot(infinite, np.ones_like(infinite), "x", color=panels.VERMILLION, transform=edge)
                axes.axhline(limit, color=panels.GREY, linestyle=panels.DASHED, linewidth=1.0)
                label = fill(f"{name}, {unit}", _LABEL) if axes is grid[row][0] else ""
                panels.style(axes, label, "", key if row == len(figures) - 1 else "")
                axes.margins(0.06)
                axes.xaxis.set_major_locator(MaxNLocator(4))
            known = values[np.isfinite(values)]
            if known.min() > 0.0 and known.max() > 30.0 * known.min():
                grid[row][0].set_yscale("log")
        save(figure, file)
    return True
