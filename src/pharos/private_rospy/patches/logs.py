"""What a node logs, on the screen and in its file."""
import contextlib
import sys

import rospkg

from pharos.private_rospy.logs import note_shown
from pharos.private_rospy.module_proxy import ModuleProxy
from pharos.private_rospy.patches.table import patch, substitute

_ESCAPED = '$\0{'  # for '${', by which rosgraph's format names the parts of a line


@substitute(
    'rosgraph.roslogging',
    '_defaultFormatter',
    "takes '${time:' in a message for its own format; does not say which node of a process logs",
)
def default_formatter(*, node, module, original):
    """Escape what looks like a part of a line, and name the node, unless a format says what a line
    has."""

    def format_(record):
        text = original.format(record).replace('${', _ESCAPED)
        is_named = node.names_log_lines and 'ROSCONSOLE_FORMAT' not in module.os.environ
        return f'{node.name}: {text}' if is_named else text

    return ModuleProxy(original, format=format_)


@substitute(
    'rosgraph.roslogging', 'rospkg', 'reads the manifests of all packages at the start of each node'
)
def packages():
    """Read them once."""
    return ModuleProxy(rospkg, RosPack=rospkg.RosPack.get_instance)


class _Screen:
    """The process's sys.stdout, or sys.stderr, as it is at the time of each line."""

    def __init__(self, name):
        self._name = name

    @property
    def present(self):
        """The stream; None where the program was started without it."""
        return getattr(sys, self._name)


@patch(
    'rosgraph.roslogging',
    'RosStreamHandler.__init__',
    'keeps the streams of its making, also where a prompt, say, replaces them to write above it',
)
def init(self, colorize=True, stdout=None, stderr=None, *, original):
    """Write where the process does then; what a program has replaced for itself stays."""
    original(self, colorize, stdout, stderr)
    if self._stdout is sys.stdout:
        self._stdout = _Screen('stdout')
    if self._stderr is sys.stderr:
        self._stderr = _Screen('stderr')


@patch('rosgraph.roslogging', 'RosStreamHandler.emit', 'makes a closed screen an error of who logs')
def emit(self, record, *, original):
    """Write what can be written."""
    with contextlib.suppress(OSError, ValueError):  # nobody is there to read it
        original(self, record)


@patch('rosgraph.roslogging', 'RosStreamHandler._write', 'needs a screen')
def write(self, fd, msg, color, *, original):
    """Show the message as it is."""
    if isinstance(fd, _Screen):
        fd = fd.present
    if fd is not None:  # the program was started without that one
        original(self, fd, msg.replace(_ESCAPED, '${'), color)
        note_shown()
