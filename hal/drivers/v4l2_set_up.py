"""Sets up a V4L2 camera: image format, gain, range of exposures; and what the kernel's errors mean."""

from __future__ import annotations

import errno
import os

from hal.buses import videodev2
from hal.buses.v4l2 import ControlRange, Layout, VideoDevice
from hal.drivers.v4l2_settings import V4l2Settings
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, OutOfRange, Refused


def open_device(name: str) -> VideoDevice:
    """Return the open device. Raises NotResponding or Refused, with the cure."""
    try:
        return VideoDevice(name)
    except FileNotFoundError as error:
        raise NotResponding(
            name,
            "no such camera: is it plugged in, and does a udev rule give it this name "
            "(deploy/99-knightcube.rules)? `v4l2-ctl --list-devices` lists what there is",
        ) from error
    except PermissionError as error:
        raise Refused(name, "no permission: add the user to the group video") from error
    except OSError as error:
        raise meaning(name, error, "opening it") from error


def meaning(name: str, error: OSError, doing: str) -> DeviceError:
    """Return the device error that an errno of the kernel means."""
    if error.errno in {errno.ENODEV, errno.ENXIO}:
        return NotResponding(name, f"gone while {doing}: was it unplugged?")
    if error.errno == errno.EBUSY:
        return Refused(name, f"busy while {doing}: another program has the camera")
    if error.errno == errno.ENOTTY:
        return Refused(name, f"is no V4L2 device (found {doing})")
    return NotResponding(name, f"failed while {doing}: {os.strerror(error.errno or errno.EIO)}")


def identity(name: str, device: VideoDevice) -> tuple[str, str]:
    """Return the names of driver and card. Raises Refused when this node delivers no video."""
    driver, card, can = device.capability()
    if not (can & videodev2.CAP_VIDEO_CAPTURE and can & videodev2.CAP_STREAMING):
        raise Refused(name, f"{card} ({driver}) delivers no video here: give its capture node")
    return driver, card


def set_format(device: VideoDevice, settings: V4l2Settings, card: str) -> Layout:
    """Set the image format; raises Refused or CorruptData when the camera has no such format."""
    name = settings.path
    layout = device.set_format(settings.columns, settings.rows, settings.pixel_format)
    if layout.fourcc != settings.pixel_format:
        offered = ", ".join(device.formats()) or "none"
        raise Refused(name, f"{card} has no pixel format {settings.pixel_format}; it offers {offered}")
    if (layout.columns, layout.rows) != (settings.columns, settings.rows):
        raise Refused(
            name,
            f"{card} gives {layout.columns} x {layout.rows} pixels, not {settings.columns} x "
            f"{settings.rows}: `v4l2-ctl --list-formats-ext` lists its sizes",
        )
    if layout.stride < layout.columns * settings.kind.itemsize:
        raise CorruptData(name, f"{card} claims rows of {layout.stride} bytes for {layout.columns} pixels")
    return layout


def set_gain(device: VideoDevice, settings: V4l2Settings) -> None:
    """Set the gain and switch its automatic control off. Raises Refused or OutOfRange."""
    if device.control_range(videodev2.AUTO_GAIN) is not None:
        device.set_control(videodev2.AUTO_GAIN, 0)
    gain = settings.gain
    if gain is None:
        return
    for control in (videodev2.GAIN, videodev2.ANALOGUE_GAIN):
        known = device.control_range(control)
        if known is not None:
            if not known.minimum <= gain <= known.maximum:
                raise OutOfRange(settings.path, "gain", gain, known.minimum, known.maximum, "")
            device.set_control(control, gain)
            return
    raise Refused(settings.path, "has no gain to set: leave `gain` out")


def manual_exposures(name: str, device: VideoDevice, card: str) -> ControlRange:
    """Switch automatic exposure off; return the range of exposures. Raises Refused without one."""
    exposures = device.control_range(videodev2.EXPOSURE_ABSOLUTE)
    if exposures is None:
        raise Refused(name, f"{card} has no exposure to be set in units of time (exposure_absolute)")
    if device.control_range(videodev2.EXPOSURE_AUTO) is not None:
        device.set_control(videodev2.EXPOSURE_AUTO, videodev2.EXPOSURE_MANUAL)
    return exposures
