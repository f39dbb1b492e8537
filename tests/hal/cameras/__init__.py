"""Cameras behind the frame source: V4L2 over a replaced ioctl, Aravis with its own fake, the emulated one."""
