"""Controllers of one axis to compare with the tracker: PID and adaptive."""
