"""The process's own rospy, imported without leaving a trace in the host program's logging."""
import logging

# rosgraph.roslogging sets the process-wide logger class when imported. rospy itself needs only the logger
# 'rosout' to be of that class, so take that one and give the class back.
_logger_class = logging.getLoggerClass()
import rospy  # noqa: E402
logging.getLogger('rosout')
logging.setLoggerClass(_logger_class)
