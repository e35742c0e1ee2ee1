"""Pictures of what cameras send: sensor_msgs/Image and CompressedImage."""
import io
import struct
import warnings
from typing import Any, Dict, Tuple

import numpy
from PIL import Image

from pharos.errors import MessageTypeError, suggest

#: encoding -> the type of its numbers, how many a pixel has, and which of them are red, green, blue
#: and alpha
_COLORS: Dict[str, Tuple[str, int, Tuple[int, ...]]] = {
    'rgb8': ('u1', 3, (0, 1, 2)),
    'bgr8': ('u1', 3, (2, 1, 0)),
    'rgba8': ('u1', 4, (0, 1, 2, 3)),
    'bgra8': ('u1', 4, (2, 1, 0, 3)),
    'rgb16': ('u2', 3, (0, 1, 2)),
    'bgr16': ('u2', 3, (2, 1, 0)),
    'rgba16': ('u2', 4, (0, 1, 2, 3)),
    'bgra16': ('u2', 4, (2, 1, 0, 3)),
    '8UC3': ('u1', 3, (2, 1, 0)),
    '8UC4': ('u1', 4, (2, 1, 0, 3)),
    'mono8': ('u1', 1, (0,)),
    '8UC1': ('u1', 1, (0,)),
    'mono16': ('u2', 1, (0,)),
}
#: encodings of measured values, such as depths, drawn from the least, dark, to the greatest
_VALUES = {'8SC1': 'i1', '16UC1': 'u2', '16SC1': 'i2', '32SC1': 'i4', '32FC1': 'f4', '64FC1': 'f8'}
#: encoding -> the columns and rows, in each square of four pixels, of red, both greens, and blue
_BAYER = {
    'bayer_rggb': ((0, 0), (0, 1), (1, 0), (1, 1)),
    'bayer_bggr': ((1, 1), (0, 1), (1, 0), (0, 0)),
    'bayer_gbrg': ((1, 0), (0, 0), (1, 1), (0, 1)),
    'bayer_grbg': ((0, 1), (0, 0), (1, 1), (1, 0)),
}
#: encoding -> where, in each pair of pixels of four bytes, both brightnesses and the colours are
_YUV = {'yuv422': ((1, 3), 0, 2), 'yuv422_yuy2': ((0, 2), 1, 3)}
ENCODINGS = [
    *_COLORS,
    *_VALUES,
    *(name + bits for name in _BAYER for bits in ('8', '16')),
    *_YUV,
]


def image_picture(message: Any) -> Image.Image:
    """The picture in a sensor_msgs/Image.

    One of a Bayer sensor has half the width and height. Depths and other values are drawn from the
    least, dark, to the greatest; what is none is black.

    :raises MessageTypeError: if its encoding is not known, or it has fewer bytes than it says
    """
    encoding = message.encoding
    bayer, bits = encoding.rstrip('0123456789'), encoding.lstrip('abcdefghijklmnopqrstuvwxyz_')
    if encoding in _COLORS:
        kind, channels, order = _COLORS[encoding]
        pixels = _bytes(_pixels(message, kind, channels)[:, :, order])
        return Image.fromarray(pixels[:, :, 0] if channels == 1 else pixels)
    if encoding in _VALUES:
        return values_picture(_pixels(message, _VALUES[encoding], 1)[:, :, 0])
    if bayer in _BAYER and bits in ('8', '16'):
        return _from_bayer(_pixels(message, 'u1' if bits == '8' else 'u2', 1)[:, :, 0], bayer)
    if encoding in _YUV:
        return _from_yuv(_pixels(message, 'u1', 2), *_YUV[encoding])
    raise MessageTypeError(
        f'no picture is made of an image with the encoding {encoding!r}{suggest(encoding, ENCODINGS)}:'
        f' known are {", ".join(ENCODINGS)}'
    )


def _pixels(message: Any, kind: str, channels: int) -> Any:
    """The numbers of an image: rows of pixels of channels."""
    dtype = numpy.dtype(kind).newbyteorder('>' if message.is_bigendian else '<')
    width, height, data = message.width, message.height, bytes(message.data)
    row = width * channels * dtype.itemsize
    step = message.step or row
    if not width or not height or step < row or len(data) < step * (height - 1) + row:
        raise MessageTypeError(
            f'an image of {width} x {height} pixels, {message.encoding}, has {row} bytes a row or'
            f' more: this one has {len(data)} in rows of {step}'
        )
    rows: Any = numpy.ndarray((height, row), 'u1', data, strides=(step, 1))
    return numpy.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)


def _bytes(pixels: Any) -> Any:
    """Numbers of 16 bits as those of 8."""
    return numpy.ascontiguousarray(pixels if pixels.dtype.itemsize == 1 else pixels >> 8).astype(
        'u1'
    )


def values_picture(values: Any) -> Image.Image:
    """A picture of measured values: what is not finite, or 0 as depths are that are not known, is
    black."""
    values = values.astype('f8')
    known = numpy.isfinite(values) & (values != 0)
    grey = numpy.zeros(values.shape, 'u1')
    if known.any():
        least, greatest = values[known].min(), values[known].max()
        scaled = (values[known] - least) / ((greatest - least) or 1)
        grey[known] = 40 + 215 * scaled
    return Image.fromarray(grey)


def _from_bayer(pixels: Any, pattern: str) -> Image.Image:
    """Each square of four pixels makes one."""
    height, width = (size // 2 * 2 for size in pixels.shape)
    if not height or not width:
        raise MessageTypeError('an image of a Bayer sensor has two rows and columns at the least')
    pixels = _bytes(pixels[:height, :width])
    red, green, other_green, blue = (pixels[row::2, column::2] for row, column in _BAYER[pattern])
    greens = (green.astype('u2') + other_green) // 2
    return Image.fromarray(numpy.dstack([red, greens.astype('u1'), blue]))


def _from_yuv(pixels: Any, brightness: Tuple[int, int], blue: int, red: int) -> Image.Image:
    height, width = pixels.shape[0], pixels.shape[1] // 2 * 2
    pairs = pixels[:, :width].reshape(height, width // 2, 4)
    y = pairs[:, :, brightness].reshape(height, width)
    colors = [numpy.repeat(pairs[:, :, at], 2, axis=1) for at in (blue, red)]
    return Image.fromarray(numpy.dstack([y, *colors]), 'YCbCr').convert('RGB')


#: what compressed images may be. Who sends them is not known: other formats of Pillow's have it
#: start programs, or have more ways to go wrong
FORMATS = 'JPEG', 'JPEG2000', 'PNG', 'TIFF', 'WEBP', 'BMP', 'GIF', 'PPM'
_BOMBS = Image.DecompressionBombError, Image.DecompressionBombWarning


def compressed_picture(message: Any) -> Image.Image:
    """The picture in a sensor_msgs/CompressedImage, also of a depth camera.

    :raises MessageTypeError: if nobody here can read it
    """
    data = bytes(message.data)
    is_depth = 'compressedDepth' in message.format
    header, data = (data[:12], data[12:]) if is_depth else (b'', data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('error', Image.DecompressionBombWarning)
            picture = Image.open(io.BytesIO(data), formats=FORMATS)
            picture.load()
    except (*_BOMBS, OSError, SyntaxError, ValueError) as error:
        raise MessageTypeError(
            f'a compressed image, {message.format!r}, of {len(data)} bytes cannot be read: {error}'
        ) from error
    if is_depth:
        return values_picture(_depths(numpy.asarray(picture), header, message.format))
    return picture.convert('RGB') if picture.mode in ('CMYK', 'YCbCr') else picture


def _depths(coded: Any, header: bytes, format_: str) -> Any:
    """The depths that compressed_depth_image_transport has coded: those of floats as a / (code - b).

    Its header has a number for the format, then a and b.
    """
    if not format_.startswith('32FC1'):
        return coded
    _, a, b = struct.unpack('<iff', header)
    depths = numpy.full(coded.shape, numpy.nan)
    known = coded > 0
    depths[known] = a / (coded[known].astype('f8') - b)
    return depths
