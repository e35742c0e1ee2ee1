"""A node whose delegate calls its base class's."""
from driver import Driver


class Derived(Driver):
    """Has a delegate that calls super()."""

    by = None

    def on_step(self, message, channel):
        super().on_step(message, channel)
        self.by = 'first'
