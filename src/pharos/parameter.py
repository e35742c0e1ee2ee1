"""Parameters of the parameter server, bound to a node both ways."""


class Parameter:
    """A parameter as a node sees it; made by :meth:`Node.parameter`.

    :attr:`name` is its global name.
    """

    def __init__(self, node, name, initialized=None):
        self.node, self.name, self._kind = node, name, type(initialized)
        if initialized is not None and not node.ros.has_param(name):
            node.ros.set_param(name, initialized)

    @property
    def value(self):
        """Its value on the parameter server now; None where it has none."""
        return self.node.ros.get_param(self.name, None)

    def set(self, value):
        """Set it on the parameter server.

        :raises ValueError: if it was initialized with a value of another type
        """
        if self._kind is not type(None) and not self._fits(value):
            raise ValueError('%s holds %s, so %r cannot be set: initialize it with None to allow any type'
                             % (self.name, self._kind.__name__, value))
        self.node.ros.set_param(self.name, value)

    def _fits(self, value):
        if self._kind is float:
            return isinstance(value, (int, float)) and not isinstance(value, bool)
        return type(value) is self._kind

    def __repr__(self):
        return '<Parameter %s of %s>' % (self.name, self.node.name)
