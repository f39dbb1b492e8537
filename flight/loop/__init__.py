"""The flight application once its devices are open: builds the rooms, lays the rate groups, runs, ends."""
