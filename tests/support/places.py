"""Paths of the repository that several tests read."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


DEMO = ROOT / "config" / "step_demo.yaml"
