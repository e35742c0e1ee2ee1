"""How a node becomes one of another class while it runs."""
import functools
from typing import (
    TYPE_CHECKING,
    Any,
    Callable,
    Iterator,
    List,
    NamedTuple,
    Optional,
    Sequence,
    Tuple,
)

from pharos.blocks import BlockOf, check_block
from pharos.channel import InputChannel
from pharos.errors import PharosError
from pharos.offered_service import OfferedService

if TYPE_CHECKING:
    from pharos.node import Node


class Place(NamedTuple):
    """Where a node has a block."""

    kind: str  # such as 'delegate'
    of: str  # what that is of
    block: BlockOf
    parameters: Sequence[str]  # that it is called with
    # takes what it becomes; None: the place looks that up itself
    take: Optional[Callable[[Any], Any]]


def become(node: 'Node', node_class: type) -> None:
    """What :meth:`Node.become` does, when no delegate of the node runs."""
    run = node.latest_run
    if run is None or not run.dispatcher.run_in_turn(lambda: _change(node, node_class)):
        _change(node, node_class)  # it has no turns


def _change(node: 'Node', node_class: type) -> None:
    changes = _changes(node, node_class)
    souls = node.latest_run.souls.forked if node.latest_run else []
    before = [(soul, soul.block_of(node)) for soul in list(souls)]
    try:
        object.__setattr__(node, '__class__', node_class)
    except TypeError as error:
        raise TypeError(
            f'{node.name} cannot become a {node_class.__name__}, whose instances are laid out in'
            f' another way ({error}): give both classes the same __slots__, or create() a node'
        ) from error
    for take, block in changes:
        take(block)
    for soul, block in before:
        if soul.block_of(node) != block:
            soul.is_asked = True


def _changes(node: 'Node', node_class: type) -> List[Tuple[Callable[[Any], Any], Any]]:
    """Who is to take which block, all of them looked up, and checked."""
    changes, gone = [], []
    for place in places(node):
        block = place.block.as_of(node_class)
        if block is None:
            gone.append(f'{place.block.method}, the {place.kind} of {place.of}')
        elif place.block.method is not None:
            check_block(block, place.kind, place.parameters)
            if place.take is not None:
                changes.append((place.take, block))
    if gone:
        raise PharosError(
            f'{node.name} cannot become a {node_class.__name__}, which has no {"; no ".join(gone)}:'
            ' define it, or give the node another block first'
        )
    return changes


def places(node: 'Node') -> Iterator[Place]:
    """The blocks of a node that there are."""

    def held(holder: Any, attribute: str, kind: str, of: str, *parameters: str) -> Iterator[Place]:
        block = getattr(holder, attribute)
        if block is not None:
            take = functools.partial(setattr, holder, attribute)
            yield Place(kind, of, BlockOf(node, block, kind == 'soul'), parameters, take)

    yield from held(node, 'delegate', 'delegate', node.name, 'message', 'channel')
    yield from held(node, 'soul', 'soul', node.name, 'node')
    run = node.latest_run
    if run is None:
        return
    for opened in run.opened:
        if isinstance(opened, InputChannel):
            yield from held(opened, 'delegate', 'delegate', opened.topic, 'message', 'channel')
        elif isinstance(opened, OfferedService):
            yield from held(opened, 'block', 'service block', opened.name, 'request')
    for soul in run.souls.forked:
        if soul.block is not None:
            yield Place('soul', f'the thread {soul.name}', soul.block, ('node',), None)
    for parameter in run.parameters:
        for given in parameter.blocks:
            yield Place('parameter block', parameter.name, given, ('value',), None)
