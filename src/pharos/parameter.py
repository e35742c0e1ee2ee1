"""Parameters of the parameter server, bound both ways."""
import functools
import threading
from copy import deepcopy

from pharos.blocks import Block, with_arguments
from pharos.channels import Endpoint


class Parameter(Endpoint):
    """A parameter of the server, as a node sees it; see :meth:`Node.parameter`.

    :ivar name: its full name
    """

    def __init__(self, node, name, initialized):
        self.node = node
        self.name = name
        self.delegate = []
        self._value = initialized
        self._read_lock = threading.Lock()
        self.open()

    def subscribe(self):
        """Hear of changes, and set the value that the node knows if the master has none."""
        run = self._run
        run.master.call('subscribeParam', run.uri, self.name, caller_id=run.name)
        if self._value is not None and self.name not in run.master.parameters:
            self.set(self._value)
        self.read()

    _open = subscribe

    def _close(self):
        """Hear of no more changes."""
        run = self._run
        run.master.call('unsubscribeParam', run.uri, self.name, caller_id=run.name)

    @property
    def value(self):
        """The value: a bool, int, float, str, list or dict; None if it has none."""
        self.node._check_active()
        return deepcopy(self._value)

    def set(self, value) -> None:
        """Set the value on the server.

        :raises ValueError: if the server cannot hold such a value
        :raises MasterUnreachableError: if the master does not answer
        """
        self.node._check_active()
        self._run.master.parameters[self.name] = value
        self._run.read_parameters()

    def read(self):
        """Take the value that the server has, and run the blocks if it is another one."""
        with self._read_lock:
            former = self._value
            value = self._run.master.parameters.get(self.name)
            self._value = value
        is_same = value == former and type(value) is type(former)
        if is_same or self.closed:  # open() reads while the parameter is still closed
            return
        for block in self.delegate:
            self._run_block(block, deepcopy(value))

    def on_change(self, block: Block) -> Block:
        """Have ``block(value)`` run when the value changes, also by others."""
        self.delegate = [*self.delegate, with_arguments(block, 'block of on_change', 1, 1)]
        return block

    def _run_block(self, block, value):
        try:
            block(value)
        except BaseException as error:
            retry = functools.partial(self._run_block, block)
            self._run.report_failure(error, block, 'block of on_change', value, retry=retry)
