"""All that the flight application sees of the hardware: readings, commands, Protocols, errors.

`readings` are the values that travel up, `devices` the Protocols of what gives and takes them,
`wires` the Protocols of the buses below the drivers (hal and sim_hal both provide those), `guardian` those of
who watches the flight from outside.
"""
