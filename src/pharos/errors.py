"""The errors of this package: each says what failed, on what name, and what to do next."""
import difflib
from typing import Iterable, List, Optional

from pharos.private_rospy.process_rospy import rospy


class PharosError(rospy.ROSException):
    """Base of all errors of this package; ``except rospy.ROSException`` catches them too."""


class MasterUnreachableError(PharosError):
    """No ROS master answers at the URL."""


class NodeNameInUseError(PharosError):
    """Another running node has the name."""


class PortInUseError(PharosError):
    """The TCPROS or XML-RPC port asked for cannot be bound."""


class UnknownNodeError(PharosError):
    """The master knows no node of that name."""


class UnknownTopicError(PharosError):
    """The master knows no topic of that name, or no type for it, or nobody publishes on it."""


class UnknownTypeError(PharosError):
    """No definition of a message or service type was found, or it cannot be read."""


class MessageTypeError(PharosError):
    """A message, field or type does not fit where it was given."""


class UnknownServiceError(PharosError):
    """The master knows no service of that name."""


class ServiceTypeError(PharosError):
    """The md5sum or type of a service is not the provider's."""


class ServiceCallError(PharosError):
    """A service call failed, or its provider did not answer in time."""


class NodeStoppedError(PharosError):
    """The node is not running."""


def missing(what: str, error: object, packages: str) -> str:
    """The complaint about what is not installed.

    :param what: what it is needed for: 'matplotlib draws plots'
    :param error: what was said of it
    :param packages: Debian's names for it
    """
    return f'{what} ({error}): sudo apt-get install {packages}'


def suggest(name: str, names: Iterable[str], meant: Optional[List[str]] = None) -> str:
    """The hint that ends a complaint about a wrong name: ``" (did you mean 'x' or 'y'?)"``.

    :param names: those that there are; of them, the ones that differ by a slip are suggested
    :param meant: what is suggested instead, if that is anything
    :returns: nothing where there is nothing to suggest
    """
    meant = meant or difflib.get_close_matches(str(name), list(names), 3, 0.7)
    return f" (did you mean {' or '.join(map(repr, meant))}?)" if meant else ''
