"""Table of the ground commands. The program `knightcube` finds this table by an entry point."""

_TABLE = """\
command         operate satellite:configure_command send a command to a flight
parameters      operate satellite:configure_parameters show, change, save and load a flight's parameters
keys            operate station:configure_keys make keys for an authenticated link
files           operate satellite:configure_files list, get and put the files of a satellite
renewal         operate renewal:configure sign, activate and confirm new software or files of a satellite
gateway         operate station:configure_gateway relay plain packets between a ground station and the link
mission-control operate mission_control:configure run the mission control system Yamcs for a satellite
watch           operate station:configure_watch show a flight in the terminal, in progress or finished
console         operate station:configure_console show and command a flight in the browser, live or replayed
report          fly     runs:configure_report report the performance of a run
export          fly     runs:configure_export write a run's packets as CSV, Parquet or SQLite
campaign        fly     campaign:configure run a configuration many times with random values
orbit           sky     runs:configure_orbit determine initial orbits of the objects that a flight tracked
new-satellite   make    new_satellite:configure write a configuration for your own satellite
passes          plan    elements:configure_passes predict the passes of a satellite over ground stations
day             plan    elements:configure_day draw targets, passes and eclipses of a day
elements        plan    elements:configure make two-line elements of an orbit, or fit them to positions
plan            plan    plan:configure plan a single slew
identify        plan    identify:configure identify the body's constants from a short flight
rate            sky     rate:configure estimate the body rate from a picture of star streaks
solve           sky     solve:configure determine where a picture of the sky points, and identify its stars
index           make    calibrate:configure_index make the sky index of a mission's camera
camera          sky     camera:configure take frames from the configured camera and check them
samples         make    calibrate:configure_samples render sample pictures for the other commands, with their truth
horizon         sky     horizon:configure find the nadir in a picture of the Earth's limb
bringup         fly     bringup:configure guide you through the first bench session with new hardware
calibrate       sky     calibrate:configure calibrate a camera's lens from pictures of the sky
"""
COMMANDS = {
    name: (group, purpose, target)
    for name, group, target, purpose in (line.split(maxsplit=3) for line in _TABLE.splitlines())
}
"""Group and purpose of each command, and the module and function that add its arguments to a parser."""
