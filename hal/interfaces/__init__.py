"""All that the flight application uses of the hardware: readings, commands, Protocols, errors.

`readings` are the values from devices, `devices` the Protocols of the devices, `wires` the Protocols of the
buses below the drivers (hal and sim_hal both implement them), `guardian` those of the processes that watch
the flight from outside.
"""
