"""Where a node is in its life."""
import enum


class Lifecycle(enum.Enum):
    """Where a node is in its life; see :attr:`Node.lifecycle`."""

    NEW = 'new'
    STARTING = 'starting'
    RUNNING = 'running'
    STOPPING = 'stopping'
    STOPPED = 'stopped'
