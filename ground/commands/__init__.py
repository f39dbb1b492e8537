"""Table of the ground commands. The program `knightcube` finds this table by an entry point."""

COMMANDS = {
    "command": ("operate", "send a command to a flight", "satellite:configure_command"),
    "parameters": (
        "operate",
        "show, change, save and load a flight's parameters",
        "satellite:configure_parameters",
    ),
    "keys": ("operate", "make keys for an authenticated link", "station:configure_keys"),
    "files": ("operate", "list, get and put the files of a satellite", "satellite:configure_files"),
    "renewal": (
        "operate",
        "sign, activate and confirm new software or files of a satellite",
        "renewal:configure",
    ),
    "gateway": (
        "operate",
        "relay plain packets between a ground station and the link",
        "station:configure_gateway",
    ),
    "mission-control": (
        "operate",
        "run the mission control system Yamcs for a satellite",
        "mission_control:configure",
    ),
    "watch": ("operate", "show a flight in the terminal, in progress or finished", "station:configure_watch"),
    "console": (
        "operate",
        "show and command a flight in the browser, live or replayed",
        "station:configure_console",
    ),
    "report": ("fly", "report the performance of a run", "runs:configure_report"),
    "export": ("fly", "write a run's packets as CSV, Parquet or SQLite", "runs:configure_export"),
    "campaign": ("fly", "run a configuration many times with random values", "campaign:configure"),
    "orbit": ("sky", "determine initial orbits of the objects that a flight tracked", "runs:configure_orbit"),
    "new-satellite": (
        "make",
        "write a configuration for your own satellite",
        "new_satellite:configure",
    ),
    "passes": ("plan", "predict the passes of a satellite over ground stations", "elements:configure_passes"),
    "day": ("plan", "draw targets, passes and eclipses of a day", "elements:configure_day"),
    "elements": (
        "plan",
        "make two-line elements of an orbit, or fit them to positions",
        "elements:configure",
    ),
    "plan": ("plan", "plan a single slew", "plan:configure"),
    "identify": ("plan", "identify the body's constants from a short flight", "identify:configure"),
    "rate": ("sky", "estimate the body rate from a picture of star streaks", "rate:configure"),
    "solve": (
        "sky",
        "determine where a picture of the sky points, and identify its stars",
        "solve:configure",
    ),
    "index": ("make", "make the sky index of a mission's camera", "calibrate:configure_index"),
    "camera": ("sky", "take frames from the configured camera and check them", "camera:configure"),
    "samples": (
        "make",
        "render sample pictures for the other commands, with their truth",
        "calibrate:configure_samples",
    ),
    "horizon": ("sky", "find the nadir in a picture of the Earth's limb", "horizon:configure"),
    "bringup": ("fly", "guide you through the first bench session with new hardware", "bringup:configure"),
    "calibrate": ("sky", "calibrate a camera's lens from pictures of the sky", "calibrate:configure"),
}
"""Group and purpose of each command, and the module and function that add its arguments to a parser."""
