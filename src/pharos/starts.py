"""The starts of nodes: of those just made, and by a start() of a class's own."""
import functools
from typing import TYPE_CHECKING, Any, Callable

from pharos import node_registry, reloading
from pharos.attributes import needs_super
from pharos.errors import NodeStoppedError

if TYPE_CHECKING:
    from pharos.node import Node


def start_made(node: 'Node') -> None:
    """Start a node that has just been made; where that fails, nothing of it is left.

    :raises NodeStoppedError: if its own start() does not start it
    """
    reloading.follow()
    with node_registry.start_of(node):
        try:
            node.start()
            if node.latest_run is None:
                raise NodeStoppedError(needs_super(node))
        except BaseException:
            node_registry.stop(node)
            raise


def of_one_run(start: Callable[..., Any]) -> Callable[..., Any]:
    """A ``start`` method of a class's own: what it does is for the run that it starts."""

    @functools.wraps(start)
    def start_in_run(node: 'Node', *args: Any, **kwargs: Any) -> Any:
        with node_registry.start_of(node):
            return start(node, *args, **kwargs)

    return start_in_run
