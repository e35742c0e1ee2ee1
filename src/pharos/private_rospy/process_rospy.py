"""The process's own rospy, imported without leaving a trace in the host program's logging."""
import logging
import _thread

# rosgraph.roslogging sets the process-wide logger class when imported. rospy itself needs only the
# logger 'rosout' to be of that class, so take that one and give the class back.
_logger_class = logging.getLoggerClass()
import rospy  # noqa: E402

logging.getLogger('rosout')
logging.setLoggerClass(_logger_class)


def on_signal(function):
    """Have ``function(number)`` run, in a thread of its own, when a signal ends the rospy node that
    the program is.

    rospy's handler keeps Ctrl-C to itself: it raises no KeyboardInterrupt.
    """

    def shut_down(reason):
        kind, _, number = reason.partition('signal-')
        if not kind and number.isdecimal():
            _thread.start_new_thread(function, (int(number),))

    rospy.core.add_preshutdown_hook(shut_down)
