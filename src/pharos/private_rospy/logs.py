"""Logging of a node's own.

rospy logs to the process-wide loggers 'rosout' and 'rospy', and ``init_node`` runs ``fileConfig``,
which strips earlier handlers: with plain copies, a line of one node appears under another's name,
twice, or not at all. A private logging module (own root, own manager, own list of handlers) lets
rospy configure it unchanged. It is not a reload of the module: that would register exit and fork
hooks.
"""
import contextlib
import logging
import logging.handlers
import threading
import time
import weakref

from pharos.intraprocess.fanout import Latch

# seconds after the start in which log lines are kept for listeners that connect later
STARTUP = 2.0

_shown = threading.local()  # .lines: how many the thread has had shown


def private_logging(imports):
    """A module that looks like ``logging`` and shares nothing with it but its classes, put into the
    set of private modules."""

    class Logger(logging.Logger):
        """``logging.Logger`` with a root and a manager of its own."""

    root = logging.RootLogger(logging.WARNING)
    manager = logging.Manager(root)
    manager.loggerClass = Logger
    for owner in Logger, root:
        owner.root, owner.manager = root, manager
    module = imports.twin(
        logging,
        root=root,
        Logger=Logger,
        setLoggerClass=manager.setLoggerClass,
        getLoggerClass=lambda: manager.loggerClass,
        # fileConfig clears these two lists, the process's own if they were shared
        _handlers=weakref.WeakValueDictionary(),
        handlers=imports.twin(logging.handlers, RotatingFileHandler=_LogFile),
        _handlerList=[],
    )
    imports.modules['logging'] = module
    module.config = imports.load_single('logging.config', module.__path__)
    # They log a traceback for each message or call that cannot be read, whoever sent it.
    for name in 'rospy.msg', 'rospy.impl.masterslave':
        manager.getLogger(name).setLevel(logging.CRITICAL)
    return module


def close_handlers(module):
    """Flush and close every handler of a private logging module, as far as the disk takes what they
    hold."""
    for logger in [module.root, *module.root.manager.loggerDict.values()]:
        for handler in list(getattr(logger, 'handlers', ())):  # a PlaceHolder has none
            logger.removeHandler(handler)
            with contextlib.suppress(OSError):
                handler.close()
    # Else logging would show what rospy itself logs later, meant for the file. What the node's code
    # says to the last is shown.
    module.root.manager.getLogger('rospy').addHandler(logging.NullHandler())


class _LogFile(logging.handlers.RotatingFileHandler):
    """A log file that is open only while a line is written, for descriptors run out with many
    nodes; what cannot be written is lost."""

    def emit(self, record):
        """Called by logging, with the handler's lock."""
        super().emit(record)
        stream, self.stream = self.stream, None
        if stream is not None:
            with contextlib.suppress(OSError):  # the disk is full
                stream.close()

    def handleError(self, record):
        """Called by logging."""


def note_shown():
    """This thread has had a line of a node's log shown on the screen."""
    _shown.lines = lines_shown() + 1


def lines_shown() -> int:
    """How many lines of nodes' logs this thread has had shown on the screen."""
    return getattr(_shown, 'lines', 0)


class StartupLines(Latch):
    """The latch of /rosout, with the first lines of a node.

    Its listeners connect a tenth of a second after the start, and would miss them.
    """

    def __init__(self):
        super().__init__()
        self._until = time.monotonic() + STARTUP
        self._lines = ()

    def keep(self, frozen, receiver):
        """Keep the line, and those before it while the node is young."""
        super().keep(frozen, receiver)
        self._lines = (*self._lines, frozen) if time.monotonic() < self._until else ()

    def of(self, receiver):
        """All lines so far, later the last one."""
        is_young = time.monotonic() < self._until
        return self._lines if is_young and self._lines else super().of(receiver)
