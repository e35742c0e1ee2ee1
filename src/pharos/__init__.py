"""PhaROS for Python: many ROS nodes in one process, written with blocks."""
import importlib
import sys
from typing import TYPE_CHECKING

try:
    import rospy as _rospy  # noqa: F401
except ModuleNotFoundError as _error:
    if _error.name != 'rospy':
        raise
    raise ModuleNotFoundError(
        f'{sys.executable} has no rospy: start this with the Python that ROS is installed for,'
        ' on Debian and Ubuntu /usr/bin/python3',
        name='rospy',
    ) from None

from pharos.channels import InputChannel, OutputChannel
from pharos.definitions import define_message, define_service, message_class, service_class
from pharos.errors import (
    MasterUnreachableError,
    MessageTypeError,
    NodeNameInUseError,
    NodeStoppedError,
    PharosError,
    PortInUseError,
    ServiceCallError,
    ServiceTypeError,
    UnknownNodeError,
    UnknownServiceError,
    UnknownTopicError,
    UnknownTypeError,
)
from pharos.failures import Failure
from pharos.master import Master
from pharos.node import BlockNode, Node
from pharos.parameter import Parameter
from pharos.private_rospy.run import Lifecycle
from pharos.private_rospy.plain import guide as _guide
from pharos.signals import live_nodes as _live_nodes
from pharos.signals import spin
from pharos.topic import Topic
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.compose.child_process import RosProcess
    from pharos.compose.composition import Composition
    from pharos.compose.script import ScriptNode
    from pharos.live.external_node import ExternalNode
    from pharos.live.graph import Graph
    from pharos.live.service_client import Service

__version__ = '0.3.0'
__all__ = [
    'Master',
    'Node',
    'BlockNode',
    'ScriptNode',
    'ExternalNode',
    'Lifecycle',
    'Topic',
    'InputChannel',
    'OutputChannel',
    'Service',
    'Parameter',
    'Transcript',
    'RosProcess',
    'Failure',
    'Composition',
    'Graph',
    'spin',
    'message_class',
    'service_class',
    'define_message',
    'define_service',
    '__version__',
    'PharosError',
    'MasterUnreachableError',
    'NodeNameInUseError',
    'PortInUseError',
    'UnknownNodeError',
    'UnknownTopicError',
    'UnknownTypeError',
    'MessageTypeError',
    'UnknownServiceError',
    'ServiceTypeError',
    'ServiceCallError',
    'NodeStoppedError',
]
_guide(_rospy, _live_nodes)
_EXTRA_MODULES = {
    'Composition': 'compose.composition',
    'ExternalNode': 'live.external_node',
    'Graph': 'live.graph',
    'RosProcess': 'compose.child_process',
    'ScriptNode': 'compose.script',
    'Service': 'live.service_client',
}


def __getattr__(name):
    """Load extras when they are used."""
    if name in _EXTRA_MODULES:
        return getattr(importlib.import_module(f'pharos.{_EXTRA_MODULES[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list:
    return __all__
