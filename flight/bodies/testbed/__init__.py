"""The testbed: a body that hangs from a thread in a fixed magnetic field and rotates about the thread."""
