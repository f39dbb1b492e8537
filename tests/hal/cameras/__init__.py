"""Tests of cameras: V4L2 with replaced ioctls, Aravis with its fake camera, and the emulated camera."""
