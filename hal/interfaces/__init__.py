"""Hardware interfaces of the flight application: Protocols of devices and buses, readings, and errors.

The module `devices` defines the Protocols of the devices and their readings. The module `wires` defines the
Protocols of the buses, which the packages hal and sim_hal implement. The module `guardian` defines the
Protocols of the processes that monitor the flight process. The module `errors` defines the exceptions.
"""
