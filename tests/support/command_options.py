"""Command-line arguments of a program as text, to be compared with their published list."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path


def arguments_of(target: str) -> list[str]:
    """Return one line for each argument of the parser that `target` (MODULE:FUNCTION) configures."""
    module, _, function = target.partition(":")
    parser = argparse.ArgumentParser()
    getattr(importlib.import_module(module), function)(parser)
    return _lines(parser)


def _lines(parser: argparse.ArgumentParser, before: str = "") -> list[str]:
    lines = []
    groups = {
        id(action): f"{'one of' if group.required else 'at most one of'} {number}"
        for number, group in enumerate(parser._mutually_exclusive_groups, start=1)
        for action in group._group_actions
    }
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                lines += [f"{before}{name}", *_lines(inner, f"{before}{name} ")]
            continue
        if isinstance(action, argparse._HelpAction) or action.help == argparse.SUPPRESS:
            continue  # a hidden option repeats an option of the parent command
        words = [" ".join(action.option_strings) or action.dest]
        if action.nargs is not None:
            words.append(f"nargs {action.nargs}")
        if action.type is not None:
            words.append(getattr(action.type, "__name__", str(action.type)))
        if action.choices is not None:
            words.append("{" + ",".join(map(str, action.choices)) + "}")
        if action.default is not None:
            words.append(f"default {'empty' if action.default == '' else action.default}")
        if action.required and action.option_strings:
            words.append("required")
        if id(action) in groups:
            words.append(groups[id(action)])
        lines.append(before + ", ".join(words))
    return lines


def published(path: Path) -> dict[str, list[str]]:
    """Return the lines of each command in a file of published arguments."""
    found: dict[str, list[str]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("  "):
            found[next(reversed(found))].append(line[2:])
        else:
            found[line.removesuffix(":")] = []
    return found
