"""The errors of this package. Each names the failure, the thing that failed, and a next step."""
import rospy


class PharosError(rospy.ROSException):
    """The base of all errors of this package; ``except rospy.ROSException`` catches them too."""


class MasterUnreachableError(PharosError):
    """No ROS master answers at the URL."""


class NodeNameInUseError(PharosError):
    """Another running node has the name."""


class PortInUseError(PharosError):
    """Another program has the TCPROS or XML-RPC port asked for."""


class UnknownNodeError(PharosError):
    """A node, program or launch file of that name was not found, or the node is not connected."""


class UnknownTopicError(PharosError):
    """The master knows no type of that topic, or nobody publishes on it."""


class UnknownTypeError(PharosError):
    """No readable definition of a message or service type was found."""


class MessageTypeError(PharosError):
    """A message, field or type does not fit its topic, service or type."""


class UnknownServiceError(PharosError):
    """The master knows no service of that name, or its provider is dead."""


class ServiceTypeError(PharosError):
    """The provider's md5sum of a service differs from the caller's."""


class ServiceCallError(PharosError):
    """A service call failed, or its provider did not answer in time."""


class NodeStoppedError(PharosError):
    """The node or channel is not open, or was stopped meanwhile."""
