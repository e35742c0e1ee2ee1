"""Parameters of the parameter server, bound to a node both ways."""
from pharos.blocks import check_block


class Parameter:
    """A parameter as a node sees it; made by :meth:`Node.parameter`.

    PhaROS 2018: ``parameter: name initialized: value``. :attr:`name` is its global name. Initialized with None it may
    hold anything, otherwise only values of that type (a float also takes integers).
    """

    def __init__(self, node, name, initialized=None):
        self.node, self.name, self._kind = node, name, type(initialized)
        self._block = None
        if initialized is not None and not node.ros.has_param(name):
            node.ros.set_param(name, initialized)

    @property
    def value(self):
        """Its value on the parameter server now; None where it has none.

        :raises ValueError: if somebody has set it to a value of another type
        """
        value = self.node.ros.get_param(self.name, None)
        return None if value is None else self._checked(value)

    def set(self, value):
        """Set it on the parameter server.

        :raises ValueError: if it was initialized with a value of another type
        """
        value = self._checked(value)
        self.node.ros.set_param(self.name, value)
        self.node._rospy.parameters.tell(self.name, value)    # the master tells all but the one who sets

    def on_change(self, block):
        """Run ``block(value)`` whenever somebody, this node too, sets the parameter; returns the block.

        It runs in a thread of the node's XML-RPC server. An exception in it is reported as a delegate's.
        """
        self._block = check_block(block, 'parameter block', ('value',))
        self.node._rospy.parameters.watch(self.name, self._changed)
        return block

    def _changed(self, value):
        try:
            self._block(self._checked(value))
        except Exception as error:
            self.node._report(error, self._block, 'parameter %s' % self.name)

    def _checked(self, value):
        fits = (self._kind is type(None) or type(value) is self._kind
                or self._kind is float and type(value) is int)
        if not fits:
            raise ValueError('%s holds %s, and %r is none: set another value, or initialize it with None to allow any '
                             'type' % (self.name, self._kind.__name__, value))
        return float(value) if self._kind is float else value

    def __repr__(self):
        return '<Parameter %s of %s>' % (self.name, self.node.name)
