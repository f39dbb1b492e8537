"""The hardware interface of the flight application: Protocols, readings, errors.

`devices` holds the Protocols of the devices and their readings, `wires` the Protocols of the buses below the
drivers (hal and sim_hal implement them), `guardian` the Protocols of the processes that watch the flight,
`errors` the exceptions.
"""
