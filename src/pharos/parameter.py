"""Parameters of the parameter server, bound both ways."""
from __future__ import annotations

import copy
import functools
import threading
import xmlrpc.client
from typing import Any

from pharos.blocks import Block, taking
from pharos.channels import Opened


def check_value(name: str, value: Any) -> None:
    """Raise ValueError if the parameter server cannot hold a value."""
    try:
        xmlrpc.client.loads(xmlrpc.client.dumps((value,)))
    except Exception as error:
        raise ValueError(f'{name} cannot be set to {value!r}: {error}') from None


class Parameter(Opened):
    """A parameter of the server, as a node sees it; see :meth:`Node.parameter`.

    :ivar name: its full name
    """

    def __init__(self, node, name, initialized):
        self.node, self.name, self._value = node, name, initialized
        self.delegate = []
        self._reading = threading.Lock()
        self.open()

    def open(self) -> None:
        """Subscribe at the master, and set the value that the node knows if there is none there."""
        self.subscribe()
        super().open()

    def subscribe(self) -> None:
        """Tell the master that the node wants to hear of changes."""
        master = self.node.master
        master.call('subscribeParam', self.node.run.uri, self.name, caller_id=self.node.name)
        if self._value is not None and self.name not in master.parameters:
            self.set(self._value)
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
        self.node.read_parameters()  # the master tells others alone

    def read(self) -> None:
        """Take the value that the server has, and tell of a change."""
        with self._reading:
            before, self._value = self._value, self.node.master.parameters.get(self.name)
            value = self._value
        if not self.closed and (value, type(value)) != (before, type(before)):
            for block in self.delegate:
                self._run(block, copy.deepcopy(value))

    def on_change(self, block: Block) -> Block:
        """Have ``block(value)`` run when it changes, also by others."""
        self.delegate = [*self.delegate, taking(block, 'block of on_change', 1)]
        return block

    def _run(self, block, value):
        try:
            block(value)
        except BaseException as error:
            run = functools.partial(self._run, block)
            self.node.report(error, block, 'block of on_change', value, again=run)

    def __repr__(self) -> str:
        return f'<Parameter {self.name} of {self.node.name}: {self.value!r}>'
