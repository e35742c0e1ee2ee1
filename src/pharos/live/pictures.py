"""Messages of which a picture says more: images, scans, paths, maps, clouds of points."""
import importlib
import io
from typing import TYPE_CHECKING, Any, Dict, Optional, Tuple

import genpy

from pharos.errors import MessageTypeError, PharosError, missing
from pharos.live.message_text import text_of_message

if TYPE_CHECKING:
    from PIL.Image import Image

SHOWN = 800, 600  # pixels that a picture has at the most in Jupyter

#: (package, message) -> the module and function that make a picture of it, loaded when one is made
_PICTURES: Dict[Tuple[str, str], Tuple[str, str]] = {
    ('sensor_msgs', 'Image'): ('images', 'image_picture'),
    ('sensor_msgs', 'CompressedImage'): ('images', 'compressed_picture'),
    ('sensor_msgs', 'LaserScan'): ('from_above', 'scan_picture'),
    ('sensor_msgs', 'PointCloud2'): ('from_above', 'cloud_picture'),
    ('nav_msgs', 'Path'): ('from_above', 'path_picture'),
    ('nav_msgs', 'OccupancyGrid'): ('from_above', 'map_picture'),
}


#: what reading and drawing raise where the values of a message are no picture's
_UNFIT = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    TypeError,
    ValueError,
)


def picture(message: genpy.Message) -> 'Image':
    """A picture of a message, as of the Python Imaging Library: ``picture(scan).save('scan.png')``.

    Of sensor_msgs' Image, CompressedImage, LaserScan and PointCloud2 (from above), and of nav_msgs'
    Path and OccupancyGrid.

    :raises MessageTypeError: if a message of its type has no picture, or its values make none
    :raises PharosError: if Pillow or NumPy is not installed
    """
    key = _key(message)
    if key not in _PICTURES:
        types = ', '.join('/'.join(key) for key in _PICTURES)
        raise MessageTypeError(
            f'no picture is made of {getattr(message, "_type", None) or repr(message)}: there are'
            f' those of {types}'
        )
    module, name = _PICTURES[key]
    try:
        draw = getattr(importlib.import_module(f'pharos.live.{module}'), name)
        with importlib.import_module('numpy').errstate(all='ignore'):  # numbers may be anything
            drawing: 'Image' = draw(message)
    except ImportError as error:
        raise PharosError(
            missing(
                'Pillow and NumPy draw pictures of messages', error, 'python3-pil python3-numpy'
            )
        ) from error
    except _UNFIT as error:  # of another definition by this name, or values that make no picture
        raise MessageTypeError(
            f'no picture can be made of this {message._type}: {error or type(error).__name__}'
        ) from error
    return drawing


def has_picture(message: Any) -> bool:
    """Whether pictures are made of messages of its type."""
    return _key(message) in _PICTURES


def _key(message: Any) -> Tuple[str, str]:
    package, _, name = str(getattr(message, '_type', '')).partition('/')
    return package, name


# -- in Jupyter


def register(ipython: Any) -> None:
    """Have an IPython show pictures of messages, and other messages, too, without endless arrays.

    The classes of messages stay as they are; those that are made later are among them.

    :param ipython: what ``get_ipython()`` returns
    """
    formatters = ipython.display_formatter.formatters
    formatters['image/png'].for_type(genpy.Message, _png)
    formatters['text/plain'].for_type(genpy.Message, _text)


def _as_png_takes_it(shown: 'Image') -> 'Image':
    if shown.mode in ('1', 'L', 'LA', 'P', 'RGB', 'RGBA'):
        return shown
    if shown.mode == 'F' or shown.mode.startswith('I'):  # measured values
        images = importlib.import_module('pharos.live.images')
        drawn: 'Image' = images.values_picture(importlib.import_module('numpy').asarray(shown))
        return drawn
    return shown.convert('RGBA' if shown.mode == 'PA' else 'RGB')


def _png(message: genpy.Message) -> Optional[bytes]:
    """A picture of the size that is shown; None where there is none."""
    if not has_picture(message):
        return None
    try:
        shown = picture(message)
    except PharosError:  # its text is shown all the same
        return None
    shown = _as_png_takes_it(shown)
    if shown.width > SHOWN[0] or shown.height > SHOWN[1]:
        shown = shown.copy()
        shown.thumbnail(SHOWN)
    file = io.BytesIO()
    shown.save(file, 'PNG')
    return file.getvalue()


def _text(message: genpy.Message, printer: Any, cycle: bool) -> None:
    printer.text(text_of_message(message))
