"""A flight watched in the terminal, from its log as it grows: mode, attitude, currents, events."""
