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
import types
import weakref

from pharos.private_rospy.loader import Substitute

_MESSAGE = '\0'  # where the message goes in a line of the screen


def private_logging():
    """A module that looks like ``logging`` and shares nothing with it but its classes and
    functions."""
    module = types.ModuleType('logging')
    vars(module).update(
        {name: value for name, value in vars(logging).items() if not name.startswith('__')}
    )
    module.__path__ = logging.__path__

    class Logger(logging.Logger):
        """``logging.Logger`` with a root and a manager of its own."""

    root = logging.RootLogger(logging.WARNING)
    manager = logging.Manager(root)
    Logger.root, Logger.manager = root, manager
    root.__class__ = type('RootLogger', (logging.RootLogger,), {'root': root, 'manager': manager})
    manager.loggerClass = Logger

    def set_logger_class(logger_class):
        manager.loggerClass = logger_class

    module.root, module.Logger = root, Logger
    module.getLogger = lambda name=None: (
        manager.getLogger(name) if name and name != 'root' else root
    )
    module.setLoggerClass = set_logger_class
    module.getLoggerClass = lambda: manager.loggerClass
    # fileConfig clears these two lists, the process's own if they were shared
    module._handlers, module._handlerList = weakref.WeakValueDictionary(), []
    return module


def hooks():
    """The load hooks of this module."""

    def mend_screen(module):
        """rosgraph.roslogging: '${time:' in a message is an error, as is a closed screen, of
        whoever logs."""
        handler, formatter = module.RosStreamHandler, module._defaultFormatter
        module._defaultFormatter = Substitute(formatter, format=lambda record: _MESSAGE)
        emit, write = handler.emit, handler._write

        def emit_what_can_be(self, record):
            self._message = formatter.format(record)
            try:
                emit(self, record)
            except (OSError, ValueError):
                pass  # nobody is there to read it

        handler.emit = emit_what_can_be

        def write_message(self, file, line, color):
            if file is None:  # the program was started without that one
                return
            write(self, file, line.replace(_MESSAGE, self._message), color)

        handler._write = write_message

    return {'rosgraph.roslogging': mend_screen}


def close_handlers(module):
    """Flush and close every handler of a private logging module, as far as the disk takes what they
    hold."""
    for logger in [module.root, *module.root.manager.loggerDict.values()]:
        for handler in list(getattr(logger, 'handlers', ())):  # a PlaceHolder has none
            logger.removeHandler(handler)
            with contextlib.suppress(OSError):
                handler.close()
