"""The Transcript: where blocks show things."""
import sys
import threading

from pharos.blocks import check_block


class _Transcript:
    """Shows things a line each, from any thread, on standard output or wherever :meth:`on_show` says.

    The report (listing 3.3)::

        Transcript show: message value asString
        Transcript.show(message)
    """

    def __init__(self):
        self._lock = threading.RLock()    # an RLock: what receives a line may show something itself
        self._receiver = None

    def show(self, *things):
        """Show one line: ``things`` as text, separated by blanks."""
        text = ' '.join(map(str, things))
        with self._lock:
            if self._receiver is not None:
                self._receiver(text)
            else:
                print(text, file=sys.stdout, flush=True)

    def on_show(self, receiver):
        """Send lines to ``receiver(text)`` from now on; ``None`` means standard output again.

        Returns the receiver so far, so that it can be put back.
        """
        check_block(receiver, 'receiver', ('text',))
        with self._lock:
            before, self._receiver = self._receiver, receiver
        return before

    def __repr__(self):
        return '<Transcript to %s>' % ('standard output' if self._receiver is None else self._receiver)


Transcript = _Transcript()
