"""Control: coil currents from the estimated state and the path."""
