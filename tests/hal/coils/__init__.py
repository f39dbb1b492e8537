"""Tests of the I2C bus and its devices: coils, PWM chip and current monitor."""
