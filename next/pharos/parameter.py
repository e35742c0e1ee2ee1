"""Parameters of the parameter server, bound both ways."""
from __future__ import annotations

import copy
import threading
import xmlrpc.client
from typing import TYPE_CHECKING, Any

from pharos.blocks import Block, rebound, taking

if TYPE_CHECKING:
    from pharos.node import Node


def check_value(name: str, value: Any) -> None:
    """Raise ValueError if the parameter server cannot hold a value."""
    try:
        xmlrpc.client.loads(xmlrpc.client.dumps((value,)))
    except Exception as error:
        raise ValueError(f'{name} cannot be set to {value!r}: {error}') from None


class Parameter:
    """A parameter of the server, as a node sees it; see :meth:`Node.parameter`.

    :ivar name: its full name
    """

    def __init__(self, node: Node, name: str, initialized: Any):
        self.node, self.name, self._initialized = node, name, initialized
        self._blocks: list[Block] = []
        self._value: Any = None
        self._reading = threading.Lock()
        self.open()
        node.remember(self)

    def open(self) -> None:
        """Subscribe at the master, and set the value that the node knows if there is none there."""
        run, master = self.node.run, self.node.master
        master.call('subscribeParam', run.uri, self.name, caller_id=run.name)
        if self.name not in master.parameters:
            value = self._initialized if self._value is None else self._value
            if value is not None:
                return self.set(value)
        self.read()

    @property
    def value(self) -> Any:
        """The value: a bool, int, float, str, list or dict; None if it has none."""
        self.node.check_running()
        return copy.deepcopy(self._value)

    def set(self, value: Any) -> None:
        """Set it on the server.

        :raises ValueError: if the server cannot hold such a value
        :raises MasterUnreachableError: if the master does not answer
        """
        self.node.check_running()
        check_value(self.name, value)
        self.node.master.call('setParam', self.name, value, caller_id=self.node.name)
        self.node.parameter_changed(self.name)
        self.read()

    def overlaps(self, name: str) -> bool:
        """True if it is that parameter, or one below or above it."""
        own, other = f'{self.name}/', f'{name}/'
        return own.startswith(other) or other.startswith(own)

    def read(self) -> None:
        """Take the value that the server has, and tell of a change."""
        with self._reading:
            before, self._value = self._value, self.node.master.parameters.get(self.name)
            value = self._value
        for block in self._blocks if value != before or type(value) is not type(before) else ():
            self._run(block, copy.deepcopy(value))

    def on_change(self, block: Block) -> Block:
        """Have ``block(value)`` run when it changes, also by others."""
        self._blocks = [*self._blocks, taking(block, 'block of on_change', 1)]
        return block

    def _run(self, block: Block, value: Any) -> None:
        def again(value):
            self._run(block, value)

        try:
            block(value)
        except BaseException as error:
            self.node.report(error, block, 'block of on_change', value, again=again)

    def rebind(self) -> None:
        self._blocks = [rebound(block, self.node) for block in self._blocks]

    def node_stopped(self) -> None:
        """Do nothing: the value is kept."""

    def __repr__(self) -> str:
        return f'<Parameter {self.name} of {self.node.name}: {self.value!r}>'
