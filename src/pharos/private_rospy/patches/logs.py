"""What a node logs on the screen."""
import contextlib

from pharos.private_rospy.module_proxy import ModuleProxy
from pharos.private_rospy.patches.table import patch, substitute

_ESCAPED = '$\0{'  # for '${', by which rosgraph's format names the parts of a line


@substitute(
    'rosgraph.roslogging', '_defaultFormatter', "takes '${time:' in a message for its own format"
)
def default_formatter(*, original):
    """Escape what looks like a part of a line."""
    return ModuleProxy(
        original, format=lambda record: original.format(record).replace('${', _ESCAPED)
    )


@patch('rosgraph.roslogging', 'RosStreamHandler.emit', 'makes a closed screen an error of who logs')
def emit(self, record, *, original):
    """Write what can be written."""
    with contextlib.suppress(OSError, ValueError):  # nobody is there to read it
        original(self, record)


@patch('rosgraph.roslogging', 'RosStreamHandler._write', 'needs a screen')
def write(self, fd, msg, color, *, original):
    """Show the message as it is."""
    if fd is not None:  # the program was started without that one
        original(self, fd, msg.replace(_ESCAPED, '${'), color)
