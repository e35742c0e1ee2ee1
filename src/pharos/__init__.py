"""PhaROS for Python: many ROS nodes in one process, written with blocks."""
from typing import TYPE_CHECKING

from pharos.channel import InputChannel
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
from pharos.external_node import ExternalNode
from pharos.failures import Failure
from pharos.lifecycle import Lifecycle
from pharos.output_channel import OutputChannel
from pharos.master import Master
from pharos.messages import (
    define_message,
    define_service,
    message_class,
    service_class,
)
from pharos.node import BlockNode, Node
from pharos.parameter import Parameter
from pharos.ros_process import RosProcess
from pharos.node_registry import spin
from pharos.on_demand import __dir__, __getattr__  # noqa: F401  # PEP 562
from pharos.service import Service
from pharos.topic import Topic
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.compose.composition import Composition
    from pharos.compose.script import ScriptNode
    from pharos.live.graph import Graph

__version__ = '0.2.0'
__all__ = [
    'Master',
    'Node',
    'BlockNode',
    'ScriptNode',
    'Lifecycle',
    'ExternalNode',
    'Topic',
    'InputChannel',
    'OutputChannel',
    'Service',
    'Parameter',
    'Transcript',
    'RosProcess',
    'Composition',
    'Graph',
    'Failure',
    'message_class',
    'service_class',
    'define_message',
    'define_service',
    'spin',
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
