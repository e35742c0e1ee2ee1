"""PhaROS for Python: many ROS nodes in one process, written with blocks."""
from pharos.channels import InputChannel, OutputChannel, Topic
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
from pharos.master import Master
from pharos.messages import define_message, define_service, message_class, service_class
from pharos.node import BlockNode, Lifecycle, Node
from pharos.parameter import Parameter
from pharos.program import spin
from pharos.ros_process import RosProcess
from pharos.service import Service
from pharos.transcript import Transcript

__version__ = '0.3.0'
__all__ = [
    'Master',
    'Node',
    'BlockNode',
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
