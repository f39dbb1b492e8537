"""Words of command lines: what may stand in any place, and lines that are right."""

from __future__ import annotations

from tests.support.furnishings import FIELD_DEG

FLIGHT = "../flight.sock"

PATHS = (
    "good.yaml", "bad.yaml", "notes.txt", "run", "runs", "empty", "nowhere/run", "nowhere.png", "flat.png",
    "short.png", "camera.yaml", "flown", "sky.fits", "sky.tiff", "limb.png", FLIGHT, ".", "..",
    "./run/../run", "/dev/null", "/dev/full", "/nonexistent/x", "a" * 300,
    "\udcff\udcfe", "é ü", "-", "new", "run/flight-0001.ccsds", "", " ",
)  # fmt: skip
NUMBERS = (
    "0", "1", "-1", "0.2", "-0.3", "1e-5", "1e9", "1e308", "-1e308", "1e999", "nan", "-nan", "inf", "-inf",
    "1_0", "0x10", "1,2", "1.2.3", "½", "٣", "9" * 400, "-0.0", "20", "0.6999", "--", "1e", ".", "", " 1",
    "q", "40", "10",
)  # fmt: skip
WORDS = (
    "lq", "harris", "likelihood", "binary", "q-method", "quest", "\n", "%s", "{}", "-h", "--json", "--help",
    "--version", "--", "-", "---", "--no-figures", "@file", "run", "report", "\u202e", "x=y", "--seed=-1",
    "--out", "--out=",
)  # fmt: skip


_SKY = ("sky.png", "sky.fits", "sky.tiff", "sky.raw --raw 128x128x16")
RIGHT: dict[str, tuple[float, tuple[str, ...]]] = {
    "run": (0.25, ("good.yaml --out new", "good.yaml --out new --json --fault FAULT", "good.yaml --seed 3",
                   "whole.yaml --out new --duration 0.1", "good.yaml --archive kept --duration 2")),
    "command": (0.7, tuple(f"--to {FLIGHT} {what}" for what in (
        "ping", "safe", "safe smoke", "mode hold", "mode safe --json", "slew 0.2", "--json slew -0.3",
        "--timeout 0.5 clear imu-silent"))),
    "parameters": (0.5, (f"--to {FLIGHT}", f"--to {FLIGHT} --json modes.tumble_rate=0.3",
                         f"--to {FLIGHT} --save new.yaml", f"--to {FLIGHT} --load whole.yaml")),
    "link": (0.3, ("good.yaml --log run", "whole.yaml --log runs", "real.yaml --log new")),
    "keys": (0.3, ("new", "empty/new", "run", "nowhere/run")),
    "check": (0.25, ("good.yaml", "good.yaml --json", "whole.yaml", "real.yaml", "real.yaml --json")),
    "report": (0.4, ("run", "run --json", "run --no-figures", "runs", "flown --no-figures",
                     "run --figures new", "run flown", "flown run --json", "run flown --figures new")),
    "watch": (0.6, ("run", "run --once", "run --json", "flown", "flown --every 3 --plain", "runs --once",
                    f"{FLIGHT} --json", f"{FLIGHT} --once --patience 0.2", "run --patience 0.1")),
    "orbit": (0.3, ("run", "run --json", "flown", "flown --opm new", "run --opm new --json")),
    "export": (0.4, ("run", "run --json", "run --out new", "run --format parquet --out new",
                     "run --format sqlite --out new.sqlite", "flown --format sqlite")),
    "samples": (0.3, ("", "--out new", "--out new --seed 3 --json")),
    "plan": (0.4, ("--from 0.4 --to -0.3 --config good.yaml", "--from 0.1 --to 0.2 --config good.yaml --json",
                   "--from 0.2 --from-rate -0.1 --to 0 --to-rate 0.01 --horizon 9 --config good.yaml",
                   "--from 0.3 --to 0.1 --time-price 0.04 --nodes 12 --config good.yaml",
                   "--from 0.3 --to 0.1 --config good.yaml --picture new.png")),
    "identify": (0.05, ("flown", "flown --json", "flown --picture new.png", "flown --out new.yaml",
                        "good.yaml --run new --duration 20")),
    "rate": (0.07, ("streaks.png --fov 12 --exposure 0.2 --json", "streaks.png --fov 12 --exposure 0.2",
                    "streaks.png --camera camera.yaml --prior 0 -0.1 0 --overlay new.png",
                    "streaks.png --fov 12 --exposure 0.2 --method harris",
                    "flat.png --fov 12 --exposure 0.2 --method trajkovic-8")),
    "solve": (0.15, (*(f"{sky} --fov {FIELD_DEG:g}" for sky in _SKY), "sky.png --json",
                     "sky.png --camera camera.yaml --date 2026-11-21 --overlay new.png",
                     "sky.png --fov 12 --fov-error 0.1 --method pyramid", "flat.png --fov 12",
                     "streaks.png --fov 12 --exposure 0.2 --prior 0 -0.1 0",
                     "sky.png --fov 12 --attitude quest --centroid gaussian --json",
                     "sky.png --fov 12 --attitude triad --centroid iterative")),
    "index": (0.02, ("--camera camera.yaml --out new.npz",)),
    "camera": (0.14, ("--config camera.yaml --count 2 --out new.png", "--config camera.yaml --json",
                      "--config camera.yaml --exposure 0.1",
                      "--config camera.yaml --exposure 0.1 --rate 0.1 -0.2 0.05 --out new.png")),
    "horizon": (0.25, ("limb.png --fov 67 --altitude 515 --json", "limb.png --fov 67",
                       "limb.jpg --fov 67 --altitude 600 --overlay new.png",
                       "limb.png --fov 67 --log-response 8 24", "flat.png --camera camera.yaml",
                       "limb.png --fov 67 --altitude 515 --method circle --lines 9 --json",
                       "limb.png --fov 67 --altitude 515 --method graphic --second limb.png --turned 120",
                       "limb.png --fov 67 --method vector --second limb.png --nadir 0 0.9 0.4")),
    "calibrate": (0.06, ("sky.png --fov 12 --json", "sky.png sky.fits --fov 12 --out new.yaml",
                         "flat.png --fov 12")),
}  # fmt: skip
"""Of each command the share of right lines, dear ones seldom, and the lines."""
