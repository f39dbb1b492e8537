"""The I2C bus and all that hangs on it: coils, PWM chip, current monitor."""
