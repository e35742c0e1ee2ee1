"""Parameters of the parameter server, bound both ways."""
import collections
import difflib
import functools
import threading
from copy import deepcopy

from pharos.blocks import Block, with_arguments
from pharos.channels import Endpoint


class Parameter(Endpoint):
    """A parameter of the server, bound to a node; see :meth:`Node.parameter`.

    :ivar name: the parameter's full name
    """

    def __init__(self, node, name, initialized):
        self.node = node
        self.name = name
        self.delegate = []
        self._value = initialized
        # held from a read to its entry in _changes: they are in the order of the reads
        self._read_lock = threading.Lock()
        # the values that the blocks have not got yet
        self._changes: collections.deque = collections.deque()
        self._blocks_lock = threading.Lock()  # held by the thread that runs the blocks
        self.open()
        if self._value is None:
            near_names = difflib.get_close_matches(name, self._run.master.parameters, cutoff=0.8)
            advice = '? '.join([*near_names, 'see rosparam list'])
            node.log(f'the server has no parameter {name}: {advice}', 'warning')

    def restore(self) -> None:
        """Set the node's value if the server has none."""
        if self._value is not None and self.name not in self._run.master.parameters:
            self._run.master.parameters[self.name] = self._value

    def subscribe(self) -> None:
        """Have the master report changes, and read the value."""
        run = self._run
        run.master.call('subscribeParam', run.uri, self.name, caller_id=run.name)
        self.read()

    def _open(self) -> None:
        self.restore()
        self.subscribe()

    def _close(self) -> None:
        """Have the master report no more changes."""
        run = self._run
        run.master.call('unsubscribeParam', run.uri, self.name, caller_id=run.name)

    @property
    def value(self):
        """The value: a bool, int, float, str, list or dict; None if the server has none.

        Each access returns a copy of the value that was read last. The master calls the node at
        changes by others; the node then reads again.

        :raises NodeStoppedError: if the node has not started, or has stopped
        """
        self.node._check_active()
        return deepcopy(self._value)

    def set(self, value: object) -> None:
        """Set the value on the server, and run the node's blocks if the value is another one.

        If another thread runs the blocks already, that thread runs them on this value next.

        :raises ValueError: if the server cannot hold such a value
        :raises MasterUnreachableError: if the master does not answer
        :raises NodeStoppedError: if the node has not started, or has stopped
        """
        self.node._check_active()
        self._run.master.parameters[self.name] = value
        self._run.read_parameters(self.name)

    def read(self) -> None:
        """Read the value from the server, and run the blocks if the value is another one."""
        with self._read_lock:
            former = self._value
            value = self._run.master.parameters.get(self.name)
            self._value = value
            is_same = value == former and type(value) is type(former)
            if is_same or self.closed:  # open() reads before the parameter is open
                return
            self._changes.append(value)
        self._run_blocks()

    def _run_blocks(self) -> None:
        """Run the blocks on all changes, one after another, unless another thread does so already.

        A block may set the parameter: then the blocks run on that value, too, after this one.
        """
        while self._changes and self._blocks_lock.acquire(False):
            try:
                while self._changes:
                    value = self._changes.popleft()
                    for block in self.delegate:
                        self._run_block(block, deepcopy(value))
            finally:
                self._blocks_lock.release()

    def on_change(self, block: Block) -> Block:
        """Have ``block(value)`` run when the value changes, also by other nodes; return the block.

        The block runs in the thread that sets or reads the value: that of a delegate, if it does so. The
        blocks get the values in their order, and run one at a time. An exception of
        the block goes to :attr:`Node.failures`. What changed while the node was stopped is not told.

        :raises TypeError: if the block does not take one argument
        """
        self.delegate = [*self.delegate, with_arguments(block, 'block of on_change', 1, 1)]
        return block

    def _run_block(self, block: Block, value: object) -> None:
        try:
            block(value)
        except BaseException as error:
            retry = functools.partial(self._run_block, block)
            self._run.report_failure(error, block, 'block of on_change', value, retry=retry)
