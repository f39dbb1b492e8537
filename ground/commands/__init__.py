"""Table of the ground commands, which `python -m flight` finds by an entry point."""

COMMANDS = {
    "command": ("send a command to a flight", "satellite:configure_command"),
    "parameters": (
        "show, change, save and load a flight's parameters",
        "satellite:configure_parameters",
    ),
    "keys": ("make the keys of an authenticated link", "station:configure_keys"),
    "files": ("list, get and put the files of a satellite", "satellite:configure_files"),
    "gateway": ("relay plain packets between a ground station and the link", "station:configure_gateway"),
    "watch": ("show a flight in the terminal, in progress or finished", "station:configure_watch"),
    "console": (
        "show and command a flight in the browser, live or replayed",
        "station:configure_console",
    ),
    "report": ("report the performance of a run", "runs:configure_report"),
    "export": ("write a run's packets as CSV, Parquet or SQLite", "runs:configure_export"),
    "orbit": ("determine first orbits of the objects that a flight tracked", "runs:configure_orbit"),
    "new-satellite": ("write the configuration of a satellite of one's own", "new_satellite:configure"),
    "elements": ("make two-line elements of an orbit, or fit them to positions", "elements:configure"),
    "plan": ("plan a single slew", "plan:configure"),
    "identify": ("identify the body's constants from a short flight", "identify:configure"),
    "rate": ("estimate the body rate from a picture of star streaks", "rate:configure"),
    "solve": ("determine where a picture of the sky points, and identify its stars", "solve:configure"),
    "index": ("make the sky index of a mission's camera", "samples:configure_index"),
    "camera": ("take frames from the configured camera and check them", "camera:configure"),
    "samples": (
        "render sample pictures for the other commands, with their truth",
        "samples:configure_samples",
    ),
    "horizon": ("find the nadir in a picture of the Earth's limb", "horizon:configure"),
    "calibrate": ("calibrate a camera's lens from pictures of the sky", "calibrate:configure"),
}
"""Purpose of each command, and the module and function that add the command's arguments to a parser."""
