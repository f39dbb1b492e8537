"""The loop of the flight application: tasks, fault detection, modes, stored state, and the executive."""
