"""The process's own rospy, imported without leaving a trace in the host program's logging."""
import logging
import signal
import _thread

# rosgraph.roslogging sets the process-wide logger class when imported. rospy itself needs only the
# logger 'rosout' to be of that class, so take that one and give the class back.
_logger_class = logging.getLoggerClass()
import rospy  # noqa: E402

logging.getLogger('rosout')
logging.setLoggerClass(_logger_class)


def on_signal(function):
    """Have ``function(number)`` run, in a thread of its own, when a signal ends the rospy node that
    the program is, or comes when that node has ended before.

    rospy's handler keeps Ctrl-C to itself: it raises no KeyboardInterrupt.
    """

    def run(number, frame=None):
        _thread.start_new_thread(function, (number,))

    def shut_down(reason):
        kind, _, number = reason.partition('signal-')
        if not kind and number.isdecimal():
            run(int(number))
            return
        # rospy's handlers stay, and do no more from now on than call those that there were before
        for number, former in rospy.core._signalChain.items():
            if former in (signal.default_int_handler, signal.SIG_DFL):
                rospy.core._signalChain[number] = run

    rospy.core.add_preshutdown_hook(shut_down)
