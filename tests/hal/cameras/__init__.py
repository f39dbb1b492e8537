"""Tests of cameras: V4L2 with a replaced ioctl, Aravis with its fake camera, and the emulated camera."""
