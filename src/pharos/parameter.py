"""Parameters of the parameter server, bound to a node both ways."""
import functools
from typing import TYPE_CHECKING, Any, List

import rosgraph

from pharos.blocks import Block, BlockOf, check_block
from pharos.private_rospy.parameters import UNKNOWN, as_stored, changing

if TYPE_CHECKING:
    from pharos.node import Node


class Parameter:
    """A parameter as a node sees it; made by :meth:`Node.parameter`.

    PhaROS 2018: ``parameter: name initialized: value``.
    Initialized with None it may hold anything, otherwise only values of that type (a float also
    takes integers). A namespace is a parameter, too, whose value is a dict of what it holds.

    The blocks of :meth:`on_change` outlive a restart of the node as its channels do, and one of the
    master, after which the parameter has its initial value again.

    :ivar node: the node that sees it
    :ivar name: its full name
    :ivar blocks: what :meth:`on_change` was given
    """

    def __init__(self, node: 'Node', name: str, initialized: Any = None) -> None:
        self.node = node
        self.name = name
        self._initialized = None if initialized is None else as_stored(name, initialized)
        self._kind = type(self._initialized)
        self.blocks: List[BlockOf] = []
        if self._initialized is not None:
            watched = node.current_run.rospy.parameters
            with node.master.reached():
                watched.initialize(name, self._initialized)

    @property
    def value(self) -> Any:
        """Its value on the parameter server; None where it has none.

        It is asked for once, and then kept here until the master tells that it has changed, within
        milliseconds; what this process sets is known at once. A master that has come back empty is
        noticed within about a second, and while it is away the value is the last one. The dict or
        list that it may be is the caller's own.

        :raises ValueError: if somebody has set it to a value of another type
        :raises MasterUnreachableError: if it is not known yet, and there is no answer
        """
        parameters = self.node.current_run.rospy.parameters  # raises where it is stopped
        value = parameters.kept(self.name)
        if value is UNKNOWN:
            with self.node.master.reached():
                value = parameters.read(self.name, self._get)
        return self._checked(value)

    def _get(self) -> Any:
        self.node.current_run  # raises where it is stopped
        try:
            return self.node.master.call('getParam', self.name, caller_id=self.node.name)
        except rosgraph.MasterError:
            return None

    def set(self, value: Any) -> None:
        """Set it on the parameter server.

        :raises ValueError: if it was initialized with a value of another type, or the server can
            hold no such value
        :raises MasterUnreachableError: if there is no answer
        """
        if value is None:
            raise ValueError(
                f'{self.name} cannot be set to None: choose a value, such as an empty text or list'
            )
        value = self._checked(as_stored(self.name, value))
        watched = self.node.current_run.rospy.parameters
        with changing(self.name):
            self.node.master.call('setParam', self.name, value, caller_id=self.node.name)
        with self.node.master.reached():
            watched.tell_of_own(self.name, value)

    def on_change(self, block: Block) -> Block:
        """Run ``block(value)`` whenever somebody sets the parameter, by :meth:`set` this node too;
        returns the block.

        It gets None when the parameter is deleted. It runs in a thread of the node's XML-RPC
        server, or where :meth:`set` is called. An exception in it is reported as a delegate's, as
        is a value of another type.

        :raises MasterUnreachableError: if there is no answer; the block is not run then
        """
        if block is None:
            raise TypeError(
                f'{self.name} needs a block to run when it changes, called as block(value)'
            )
        check_block(block, 'parameter block', ('value',))
        run = self.node.current_run  # raises where it is stopped
        given = BlockOf(self.node, block)
        self.blocks.append(given)
        try:
            with self.node.master.reached():
                while True:
                    run.rospy.parameters.watch(self.name, self._changed)
                    if not run.is_over:
                        break
                    run = self.node.current_run  # the node was restarted meanwhile, or stopped
        except BaseException:
            self.blocks.remove(given)
            raise
        return block

    def _changed(self, value: Any) -> None:
        for block in tuple(self.blocks):
            self._run(block, value)

    def _run(self, given: BlockOf, value: Any) -> None:
        block = given.now
        try:
            if value == {}:
                value = self._get()  # a master says so of a deleted one, too
            block(self._checked(value))
        except BaseException as error:
            self.node.latest_run.report(
                error,
                block,
                f'parameter {self.name}',
                message=value,
                again=functools.partial(self._run, given),
            )

    def _checked(self, value: Any) -> Any:
        if value is None or self._kind in (type(None), type(value)):
            return value
        if self._kind is float and type(value) is int:
            return float(value)
        raise ValueError(
            f'{self.name} holds {self._kind.__name__}, and {value!r} is none: set another value, or'
            ' initialize it with None to allow any type'
        )

    def __repr__(self) -> str:
        return f'<Parameter {self.name} of {self.node.name}>'
