"""Compressed camera images: what they are, whether they are whole, and raw pixels made into PNG."""

import io
import struct

import cv2
import numpy as np
from PIL import Image

from streetscan.errors import BadInput
from streetscan.frames import CameraImage

_MAGIC = {b"\x89PNG\r\n\x1a\n": "png", b"\xff\xd8\xff": "jpeg"}
# ROS name of an encoding to (channels, numpy type, OpenCV conversion to what imencode wants).
_ENCODINGS = {
    "rgb8": (3, np.uint8, cv2.COLOR_RGB2BGR),
    "bgr8": (3, np.uint8, None),
    "8UC3": (3, np.uint8, None),
    "rgba8": (4, np.uint8, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, np.uint8, cv2.COLOR_BGRA2BGR),
    "mono8": (1, np.uint8, None),
    "8UC1": (1, np.uint8, None),
    "mono16": (1, np.uint16, None),
    "16UC1": (1, np.uint16, None),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": (1, np.uint8, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, np.uint8, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, np.uint8, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, np.uint8, cv2.COLOR_BayerGB2BGR),
}


def check_image(image: CameraImage) -> CameraImage:
    """The image with `format` taken from its first bytes, and status `unreadable` when it is no whole PNG or JPEG.

    A PNG's checksums are verified; of a JPEG, which has none, header and end mark. Pixels are not decoded.
    """
    image.format = next((name for magic, name in _MAGIC.items() if image.data.startswith(magic)), image.format or "png")
    try:
        with Image.open(io.BytesIO(image.data)) as opened:
            is_whole = opened.format in ("PNG", "JPEG")
            opened.verify()
        is_whole = is_whole and (image.format == "png" or b"\xff\xd9" in image.data[-64:])
    # Pillow raises whatever its parsers meet: SyntaxError, struct.error, zlib.error, OSError, ...
    except Exception:
        is_whole = False
    if not is_whole:
        image.status = "unreadable"
    return image


def image_size(image: CameraImage) -> tuple[int, int]:
    """Width and height in pixels, from the header. BadInput when it is no picture."""
    try:
        with Image.open(io.BytesIO(image.data)) as opened:
            return opened.size
    except (OSError, SyntaxError, ValueError, struct.error) as error:
        raise BadInput(image.source or "image", f"is no picture ({error})", "record it again") from error


def decode_image(image: CameraImage) -> np.ndarray:
    """Pixels (height, width, 3) uint8 RGB. BadInput when it cannot be decoded."""
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR) if image.data else None
    if pixels is None:
        raise BadInput(image.source or "image", "cannot be decoded", "record it again")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def encode_png(pixels: np.ndarray) -> bytes:
    """Pixels (height, width[, 3]) RGB or grey, uint8 or uint16, as PNG."""
    pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    # ASSUME: level 1; images of a drive are many, and level 9 is ten times slower for 5 % of the size.
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def png_to_webp(content: bytes, where: object) -> bytes:
    """A PNG file's content as WebP of quality 80. BadInput when it is no PNG."""
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    if pixels is None:
        raise BadInput(where, "cannot be decoded", "run the step that draws it again")
    return cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()


def png_of_raw(data: np.ndarray, width: int, height: int, step: int, encoding: str, is_bigendian: bool, where: object) -> bytes:
    """A ROS image's raw pixels as PNG; Bayer patterns are turned into colours.

    Args:
        data: (step * height,) uint8.
        step: bytes of a row.
        encoding: the ROS name of the pixel format.
    Raises:
        BadInput: an encoding we do not know, or fewer bytes than the size needs.
    """
    if encoding not in _ENCODINGS:
        raise BadInput(where, f"images are encoded as '{encoding}'", f"convert them to one of {', '.join(_ENCODINGS)}")
    channels, dtype, conversion = _ENCODINGS[encoding]
    row = width * channels * np.dtype(dtype).itemsize
    if width < 1 or height < 1 or step < row or len(data) < step * height:
        raise BadInput(where, f"{len(data)} bytes for {width} x {height} pixels of '{encoding}' in rows of {step}", "record it again")
    rows = np.ascontiguousarray(np.frombuffer(data, np.uint8)[: step * height].reshape(height, step)[:, :row])
    pixels = rows.view(np.dtype(dtype).newbyteorder(">" if is_bigendian else "<")).astype(dtype)
    pixels = pixels.reshape(height, width, channels) if channels > 1 else pixels.reshape(height, width)
    pixels = pixels if conversion is None else cv2.cvtColor(pixels, conversion)
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
