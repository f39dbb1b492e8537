"""Hardware abstraction layer: buses on Linux, device drivers, and the interfaces that the flight uses."""
