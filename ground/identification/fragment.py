"""The `plant` section of a configuration from what was identified, to be pasted in place of the old one."""

from __future__ import annotations

from dataclasses import replace

from flight.schema.testbed import Plant
from ground.identification.scale import AbsolutePlant, Known


def plant_section(plant: AbsolutePlant, coil_turns: int) -> Plant:
    """Return the section; a thread that came out less than zero, as noise can make it, has none."""
    return Plant(
        inertia=plant.inertia.value,
        coil_turns=coil_turns,
        coil_area=plant.dipole.value / coil_turns,
        field=plant.field.value,
        thread_stiffness=max(plant.stiffness.value, 0.0),
        thread_damping=max(plant.damping.value, 0.0),
    )


def fragment(plant: AbsolutePlant, coil_turns: int, origin: str) -> str:
    """Return the section as YAML text; `origin` names the flight."""
    section, rests = plant_section(plant, coil_turns), plant.rests_on()
    area = replace(plant.dipole, sigma=plant.dipole.sigma / coil_turns)
    lines = [
        ("inertia", section.inertia, _comment(plant.inertia, "kg m^2", rests["inertia"])),
        ("coil_turns", section.coil_turns, "taken over"),
        ("coil_area", section.coil_area, _comment(area, "m^2", rests["dipole"])),
        ("field", section.field, _comment(plant.field, "T", rests["field"])),
        (
            "thread_stiffness",
            section.thread_stiffness,
            _comment(plant.stiffness, "N m/rad", rests["stiffness"]),
        ),
        ("thread_damping", section.thread_damping, _comment(plant.damping, "N m s/rad", rests["damping"])),
    ]
    text = [f"# Made by `python -m flight identify` from {origin}; +- is 1 sigma.", "plant:"]
    for name, value, comment in lines:
        number = str(value) if isinstance(value, int) else f"{value:.6e}"
        text.append(f"  {name + ': ' + number:34s}# {comment}")
    return "\n".join(text) + "\n"


def _comment(known: Known, unit: str, rests_on: str) -> str:
    if known.value < 0.0:
        return f"{unit}: came out at {known.value:.2g} +- {known.sigma:.2g}, so none"
    return f"{unit} +- {known.sigma:.2g}: {rests_on}"
