"""The commands of the ground, one module each; `python -m flight` finds this table by its entry point."""

COMMANDS = {
    "command": "send a command to a flight",
    "parameters": "show, change, save and load the parameters of a flight",
    "keys": "make the keys of an authenticated link",
    "files": "list, get and put the files of a satellite",
    "gateway": "hand plain packets to a ground station of others, and its commands to the link",
    "watch": "show a flight in the terminal, live or as it ended",
    "console": "show a flight in the browser, live or replayed, and command it",
    "report": "report the performance of a run",
    "export": "write a run's packets as CSV, Parquet or SQLite",
    "orbit": "determine first orbits of the objects that a flight tracked",
    "plan": "plan a single slew",
    "identify": "identify the body's constants from a short flight",
    "rate": "estimate the body rate from a picture of star streaks",
    "solve": "determine where a picture of the sky points, and identify its stars",
    "index": "make the sky index of a mission's camera",
    "camera": "take frames from the configured camera and check them",
    "samples": "render pictures to try the other commands on, with their truth",
    "horizon": "find the nadir in a picture of the Earth's limb",
    "calibrate": "calibrate a camera's lens from pictures of the sky",
}
