"""Hardware abstraction layer: buses on Linux, device drivers, and the interfaces for the flight software."""
