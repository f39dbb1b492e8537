"""Table of the ground commands. The program `knightcube` finds this table by an entry point."""

_TABLE = """\
operate command satellite:configure_command send a command to a flight
operate parameters satellite:configure_parameters show, change, save and load a flight's parameters
operate keys station:configure_keys make keys for an authenticated link
operate files satellite:configure_files list, get and put the files of a satellite
operate renewal renewal:configure sign, activate and confirm new software or files of a satellite
operate gateway station:configure_gateway relay plain packets between a ground station and the link
operate mission-control mission_control:configure run the mission control system Yamcs for a satellite
operate watch station:configure_watch show a flight in the terminal, in progress or finished
operate console station:configure_console show and command a flight in the browser, live or replayed
fly     report runs:configure_report report the performance of a run
fly     export runs:configure_export write a run's packets as CSV, Parquet or SQLite
fly     campaign campaign:configure run a configuration many times with random values
sky     orbit runs:configure_orbit determine initial orbits of the objects that a flight tracked
make    new-satellite new_satellite:configure write a configuration for your own satellite
plan    passes elements:configure_passes predict the passes of a satellite over ground stations
plan    day elements:configure_day draw targets, passes and eclipses of a day
plan    elements elements:configure make two-line elements of an orbit, or fit them to positions
plan    plan plan:configure plan a single slew
plan    identify identify:configure identify the body's constants from a short flight
sky     rate rate:configure estimate the body rate from a picture of star streaks
sky     solve solve:configure determine where a picture of the sky points, and identify its stars
make    index calibrate:configure_index make the sky index of a mission's camera
sky     camera camera:configure take frames from the configured camera and check them
make    samples calibrate:configure_samples render sample pictures for the other commands, with their truth
sky     horizon horizon:configure find the nadir in a picture of the Earth's limb
fly     bringup bringup:configure guide you through the first bench session with new hardware
sky     calibrate calibrate:configure calibrate a camera's lens from pictures of the sky
"""
COMMANDS = {
    name: (group, purpose, target)
    for group, name, target, purpose in (line.split(maxsplit=3) for line in _TABLE.splitlines())
}
"""Group and purpose of each command, and the module and function that add its arguments to a parser."""
