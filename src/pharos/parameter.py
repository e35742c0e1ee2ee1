"""Parameters of the parameter server, bound both ways."""
import functools
import threading
from copy import deepcopy

from pharos.blocks import Block, taking
from pharos.channels import Opened


class Parameter(Opened):
    """A parameter of the server, as a node sees it; see :meth:`Node.parameter`.

    :ivar name: its full name
    """

    def __init__(self, node, name, initialized):
        self.node, self.name, self._value = node, name, initialized
        self.delegate = []
        self._reading = threading.Lock()
        self.open()

    def subscribe(self):
        """Hear of changes, and set the value that the node knows if the master has none."""
        master = self.node._master
        master.call('subscribeParam', self.node._run.uri, self.name, caller_id=self.node._name)
        if self._value is not None and self.name not in master.parameters:
            self.set(self._value)
        self.read()

    _open = subscribe

    def _close(self):
        """Hear of no more changes."""
        uri = self.node._run.uri
        self.node._master.call('unsubscribeParam', uri, self.name, caller_id=self.node._name)

    @property
    def value(self):
        """The value: a bool, int, float, str, list or dict; None if it has none."""
        self.node._check_running()
        return deepcopy(self._value)

    def set(self, value) -> None:
        """Set it on the server.

        :raises ValueError: if the server cannot hold such a value
        :raises MasterUnreachableError: if the master does not answer
        """
        self.node._check_running()
        self.node._master.parameters[self.name] = value
        self.node._read_parameters()

    def read(self):
        """Take the value that the server has, and tell of a change."""
        with self._reading:
            before, self._value = self._value, self.node._master.parameters.get(self.name)
            value = self._value
        if not self.closed and (value, type(value)) != (before, type(before)):
            for block in self.delegate:
                self._run(block, deepcopy(value))

    def on_change(self, block: Block) -> Block:
        """Have ``block(value)`` run when it changes, also by others."""
        self.delegate = [*self.delegate, taking(block, 'block of on_change', 1, 1)]
        return block

    def _run(self, block, value):
        try:
            block(value)
        except BaseException as error:
            run = functools.partial(self._run, block)
            self.node._report(error, block, 'block of on_change', value, again=run)
