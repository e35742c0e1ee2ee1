"""The errors of this package. Each says what failed, on what name, and what to do next."""
import rospy


class PharosError(rospy.ROSException):
    """The base of all errors of this package; ``except rospy.ROSException`` catches them too."""


class MasterUnreachableError(PharosError):
    """No ROS master answers at the URL."""


class NodeNameInUseError(PharosError):
    """Another running node has the name."""


class PortInUseError(PharosError):
    """The TCPROS or XML-RPC port asked for cannot be bound."""


class UnknownNodeError(PharosError):
    """The master knows no node of that name, or it is not interested in the topic."""


class UnknownTopicError(PharosError):
    """The master knows no type of that topic."""


class UnknownTypeError(PharosError):
    """No definition of a message or service type was found, or it cannot be read."""


class MessageTypeError(PharosError):
    """A message, a field or a type does not fit where it was given."""


class UnknownServiceError(PharosError):
    """The master knows no service of that name."""


class ServiceTypeError(PharosError):
    """The md5sum of a service is not the provider's."""


class ServiceCallError(PharosError):
    """A service call failed, or its provider did not answer in time."""


class NodeStoppedError(PharosError):
    """The node is not running, or stopped meanwhile."""
