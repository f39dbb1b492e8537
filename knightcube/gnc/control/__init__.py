"""Control laws that compute coil currents from the estimated state and the planned path."""
