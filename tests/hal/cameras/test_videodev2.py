"""Tests that structures and request codes equal the definitions in the kernel's videodev2.h."""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
from pathlib import Path
from typing import get_args

import pytest

from flight.schema.devices import PixelName
from flight.schema.reader import PIXEL_BITS
from hal.drivers import v4l2_camera as v4l2
from hal.drivers.camera import PIXEL_FORMATS, fourcc, fourcc_name

# Values of linux/videodev2.h on x86-64.
CODES = {
    "QUERYCAP": 0x80685600,
    "ENUM_FMT": 0xC0405602,
    "S_FMT": 0xC0D05605,
    "REQBUFS": 0xC0145608,
    "QUERYBUF": 0xC0585609,
    "QBUF": 0xC058560F,
    "DQBUF": 0xC0585611,
    "STREAMON": 0x40045612,
    "STREAMOFF": 0x40045613,
    "G_PARM": 0xC0CC5615,
    "S_PARM": 0xC0CC5616,
    "G_CTRL": 0xC008561B,
    "S_CTRL": 0xC008561C,
    "QUERYCTRL": 0xC0445624,
}
STRUCTURES = {
    "v4l2_capability": v4l2.Capability,
    "v4l2_fmtdesc": v4l2.FormatDescription,
    "v4l2_format": v4l2.Format,
    "v4l2_requestbuffers": v4l2.RequestBuffers,
    "v4l2_buffer": v4l2.Buffer,
    "v4l2_streamparm": v4l2.StreamParameters,
    "v4l2_control": v4l2.ControlValue,
    "v4l2_queryctrl": v4l2.QueryControl,
}
MEMBERS = [
    ("v4l2_buffer", v4l2.Buffer, ("bytesused", "flags", "timestamp", "sequence", "memory", "m", "length")),
    ("v4l2_pix_format", v4l2.PixelFormat, ("pixelformat", "field", "bytesperline", "sizeimage")),
    ("v4l2_capability", v4l2.Capability, ("card", "capabilities", "device_caps")),
    ("v4l2_format", v4l2.Format, ("fmt",)),
    ("v4l2_queryctrl", v4l2.QueryControl, ("minimum", "maximum", "step", "flags")),
]
BAYER = {
    "8": "BA81 GBRG GRBG RGGB",
    "10": "BG10 GB10 BA10 RG10",
    "12": "BG12 GB12 BA12 RG12",
    "16": "BYR2 GB16 GR16 RG16",
    "10P": "pBAA pGAA pgAA pRAA",
    "12P": "pBCC pGCC pgCC pRCC",
}
"""Names of the Bayer formats in the orders BGGR, GBRG, GRBG and RGGB, by the suffix of the kernel's names."""
MONO = {"Mono8", "Mono10", "Mono12", "Mono16"}
CONSTANTS = {
    "V4L2_BUF_FLAG_ERROR": v4l2.FLAG_ERROR,
    "V4L2_BUF_FLAG_TIMESTAMP_MASK": v4l2.STAMP_MASK,
    "V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC": v4l2.STAMP_MONOTONIC,
    "V4L2_BUF_FLAG_TSTAMP_SRC_MASK": v4l2.STAMP_SOURCE_MASK,
    "V4L2_BUF_FLAG_TSTAMP_SRC_SOE": v4l2.STAMP_START_OF_EXPOSURE,
    "V4L2_CAP_VIDEO_CAPTURE": v4l2.CAP_VIDEO_CAPTURE,
    "V4L2_CAP_STREAMING": v4l2.CAP_STREAMING,
    "V4L2_CAP_DEVICE_CAPS": v4l2.CAP_DEVICE_CAPS,
    "V4L2_CAP_TIMEPERFRAME": v4l2.CAP_TIME_PER_FRAME,
    "V4L2_BUF_TYPE_VIDEO_CAPTURE": v4l2.VIDEO_CAPTURE,
    "V4L2_MEMORY_MMAP": v4l2.MMAP,
    "V4L2_FIELD_NONE": v4l2.FIELD_NONE,
    "V4L2_CTRL_FLAG_DISABLED": v4l2.CONTROL_DISABLED,
    "V4L2_CID_AUTOGAIN": v4l2.AUTO_GAIN,
    "V4L2_CID_GAIN": v4l2.GAIN,
    "V4L2_CID_ANALOGUE_GAIN": v4l2.ANALOGUE_GAIN,
    "V4L2_CID_EXPOSURE_AUTO": v4l2.EXPOSURE_AUTO,
    "V4L2_EXPOSURE_MANUAL": v4l2.EXPOSURE_MANUAL,
    "V4L2_CID_EXPOSURE_ABSOLUTE": v4l2.EXPOSURE_ABSOLUTE,
    **{f"V4L2_PIX_FMT_{name}": fourcc(name) for name in ("GREY", "Y10", "Y12", "Y14", "Y16", "Y10P", "YUYV")},
    "V4L2_PIX_FMT_UYVY": fourcc("UYVY"),
    "V4L2_PIX_FMT_Y16_BE": fourcc("Y16-BE"),
    "V4L2_PIX_FMT_Y10BPACK": fourcc("Y10B"),
    "V4L2_PIX_FMT_MJPEG": fourcc("MJPG"),
    **{
        f"V4L2_PIX_FMT_S{order}{depth}": fourcc(name)
        for depth, names in BAYER.items()
        for order, name in zip(("BGGR", "GBRG", "GRBG", "RGGB"), names.split(), strict=True)
    },
}


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the published codes are those of x86-64")
def test_requests_are_the_published_ones() -> None:
    assert {name: getattr(v4l2, name) for name in CODES} == CODES
    assert [ctypes.sizeof(kind) for kind in (v4l2.Buffer, v4l2.Format)] == [88, 208]
    assert v4l2.Format.fmt.offset == 8
    assert fourcc("GREY") == 0x59455247
    assert fourcc("Y10") == 0x20303159


def test_names_of_pixel_formats_survive_their_code() -> None:
    assert [fourcc_name(fourcc(name)) for name in PIXEL_FORMATS] == list(PIXEL_FORMATS)
    assert set(PIXEL_FORMATS) == set(get_args(PixelName)) == {*PIXEL_BITS} - MONO
    for name, coding in PIXEL_FORMATS.items():
        assert coding.bits in PIXEL_BITS[name]


def test_all_values_agree_with_the_header_of_this_machine(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        pytest.skip("no C compiler or no kernel headers here")
    lines = [f'printf("%zu ", sizeof(struct {name}));' for name in STRUCTURES]
    lines += [f'printf("%zu ", offsetof(struct {name}, {m}));' for name, _, all_ in MEMBERS for m in all_]
    lines += [f'printf("%lu ", (unsigned long)VIDIOC_{name});' for name in CODES]
    lines += [f'printf("%lu ", (unsigned long){name});' for name in CONSTANTS]
    headers = "#include <linux/videodev2.h>\n#include <stddef.h>\n#include <stdio.h>\n"
    source, program = tmp_path / "sizes.c", tmp_path / "sizes"
    source.write_text(headers + "int main(void) {\n" + "\n".join(lines) + "\nreturn 0; }\n", encoding="ascii")
    subprocess.run([compiler, str(source), "-o", str(program)], check=True, timeout=60)
    output = subprocess.run([str(program)], check=True, timeout=10, capture_output=True, text=True).stdout
    ours = [ctypes.sizeof(kind) for kind in STRUCTURES.values()]
    ours += [getattr(kind, member).offset for _, kind, members in MEMBERS for member in members]
    ours += [getattr(v4l2, name) for name in CODES]
    ours += list(CONSTANTS.values())
    assert [int(word) for word in output.split()] == ours
