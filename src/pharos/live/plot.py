"""Numbers of a topic over time, collected from when they are asked for and drawn by matplotlib."""
import collections
import io
import os
import time
import weakref
import _thread
from typing import Any, Callable, Deque, Dict, List, Optional, Tuple, Union

import genpy

from pharos import node_registry
from pharos.channel import InputChannel
from pharos.counts import counted
from pharos.errors import NodeStoppedError, PharosError, missing
from pharos.live import graphviz
from pharos.live.colors import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from pharos.live.watching import create_looker, nothing_came
from pharos.messages.numeric_field import numeric_field
from pharos.node import BlockNode
from pharos.probe import Look, wait_for_publishers
from pharos.restarts import is_restarting
from pharos.run import Run
from pharos.seconds import check_seconds

KEPT = 100000  # messages that a plot is made of, the newest
HIGHEST = 1e300  # of numbers that matplotlib can draw; beyond, it runs out of them for its axes
#: how lines are drawn, the first first: by the dash, too, where colours are not seen
_LINES = (
    (BLUE, '-'),
    (VERMILION, '--'),
    (GREEN, '-.'),
    (PURPLE, ':'),
    (SKY, '-'),
    (ORANGE, '--'),
)


class Plot:
    """What :meth:`InputChannel.plot <pharos.InputChannel.plot>` returns: collects until
    :meth:`close`, the end of its ``with`` block, or of the program.

    Shows itself in Jupyter, each time with what there is by then. :attr:`times` are seconds since
    its beginning, :attr:`values` is ``{field: one for each of them}``, None where a message has
    none there.

    :param readers: ``{field: what takes it from a message}``
    """

    def __init__(
        self, channel: InputChannel, readers: Dict[str, Callable[[genpy.Message], Optional[float]]]
    ) -> None:
        self.topic, self.type = channel.topic, channel.type
        self.fields: List[str] = list(readers)
        run = channel.node.current_run
        self._looker = create_looker(channel.node.master)
        self._collected = _Collected(list(readers.values()), run, self._looker)
        # in a thread, for Python may free it in one that holds any lock, as a Thread's start takes
        end = _thread.start_new_thread, self._collected.end, ()
        self._freed = weakref.finalize(self, *end)
        self._freed.atexit = False
        try:
            self._looker.interested_in(
                channel.topic, channel.message_class, self._collected, from_=channel.from_
            )
        except BaseException:
            self.close()
            raise

    @property
    def times(self) -> List[float]:
        """When each message came, in seconds since the beginning."""
        return [when for when, _ in list(self._collected.rows)]

    @property
    def values(self) -> Dict[str, List[Optional[float]]]:
        """The values of each field."""
        rows = [values for _, values in list(self._collected.rows)]
        return {field: [row[at] for row in rows] for at, field in enumerate(self.fields)}

    def wait(self, seconds: float) -> 'Plot':
        """Collect for so many seconds more, from when the publishers are connected; returns this
        plot.

        :raises NodeStoppedError: if it is closed, also meanwhile, or the node stops whose thread
            this is
        """
        seconds, look = check_seconds('seconds', seconds, above=0), Look()
        if not self._looker.is_running:
            raise NodeStoppedError(
                f'the plot of {self.topic} is closed, and collects no more: plot() begins another'
            )
        wait_for_publishers(self._looker, self.topic, self._looker.connect_timeout)
        look.wait_out(self._looker, seconds)
        return self

    def close(self) -> None:
        """Collect no more; what was collected stays. Harmless when done twice."""
        self._freed.detach()
        self._collected.end()

    def __enter__(self) -> 'Plot':
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- as a picture

    def figure(self) -> Any:
        """A matplotlib Figure of what there is by now; it needs no display.

        :raises PharosError: if matplotlib is not installed
        """
        figure = load_matplotlib().Figure(figsize=(8, 4), layout='constrained')
        axes = figure.add_subplot()
        rows = list(self._collected.rows)
        times = [when for when, _ in rows]
        for at, field in enumerate(self.fields):
            color, dash = _LINES[at % len(_LINES)]
            values = [_drawable(row[at]) for _, row in rows]
            marker = '.' if len(rows) <= 50 else ''
            axes.plot(times, values, color=color, linestyle=dash, marker=marker, label=field)
        axes.set_xlabel('seconds')
        axes.set_title(
            f'{self.topic} ({self.type}): {counted(len(rows), "message")}', fontsize='medium'
        )
        axes.grid(color='#E0E0E0')
        axes.legend(loc='best')
        return figure

    def save(self, path: Union[str, 'os.PathLike[str]']) -> None:
        """Draw it into a file; the suffix of ``path`` says how: .png, .svg, .pdf and what else
        matplotlib knows.

        :raises ValueError: if matplotlib knows no such suffix
        :raises PharosError: if the file cannot be written, or matplotlib is not installed
        """
        figure = self.figure()
        format_ = graphviz.check_format(path, sorted(figure.canvas.get_supported_filetypes()))
        graphviz.write(path, _drawn(figure, format_))

    def _repr_png_(self) -> bytes:
        """The picture in Jupyter."""
        return _drawn(self.figure(), 'png')

    def __repr__(self) -> str:
        state = 'collecting' if self._looker.is_running else 'closed'
        fields, count = ', '.join(self.fields), counted(len(self._collected.rows), 'message')
        return f'<Plot of {fields} of {self.topic}: {count}, {state}>'


class _Collected:
    """What a plot has collected, and its end, without the plot: who asks for no picture any more
    may drop that."""

    def __init__(
        self,
        readers: List[Callable[[genpy.Message], Optional[float]]],
        run: Run,
        looker: BlockNode,
    ) -> None:
        self.rows: Deque[Tuple[float, List[Optional[float]]]] = collections.deque(maxlen=KEPT)
        self._readers, self._node, self._looker = readers, run.node, looker
        self._begin = time.monotonic()
        run.remember(self, 'a plot')

    def __call__(self, message: genpy.Message, channel: InputChannel) -> None:
        self.rows.append(
            (time.monotonic() - self._begin, [read(message) for read in self._readers])
        )

    def end(self) -> None:
        """Collect no more."""
        self._node.latest_run.forget(self)
        if self._looker in node_registry.nodes():  # not in a process that was forked
            self._looker.stop()

    def node_stopped(self) -> None:
        """The channel's node stops, and perhaps to be started again."""
        if not is_restarting(self._node):
            self.end()

    def open(self, run: Run) -> None:
        """The channel's node starts again."""


def _drawable(value: Optional[float]) -> float:
    """The value; one that is too high for matplotlib is left out, as infinity is."""
    return float('nan') if value is None or abs(value) > HIGHEST else value


def _drawn(figure: Any, format_: str) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format=format_)
    return file.getvalue()


def plot(channel: InputChannel, fields: Tuple[str, ...], seconds: Optional[float]) -> Plot:
    """See :meth:`InputChannel.plot <pharos.InputChannel.plot>`."""
    if not fields:
        raise TypeError("name a field to plot, such as 'linear.x'")
    if seconds is not None:
        seconds = check_seconds('seconds', seconds, above=0)
    readers = {field: numeric_field(channel.message_class, field) for field in fields}
    load_matplotlib()  # complains before there is anything to draw
    made = Plot(channel, readers)
    if seconds is None:
        return made
    with made:
        made.wait(seconds)
    if not made.times:
        raise nothing_came(channel.node.master.topic(channel.topic), seconds)
    return made


def load_matplotlib() -> Any:
    """matplotlib's module of figures, which opens no window.

    :raises PharosError: if it is not installed
    """
    try:
        import matplotlib.figure
    except ImportError as error:
        text = missing('matplotlib draws plots', error, 'python3-matplotlib')
        raise PharosError(text) from error
    return matplotlib.figure
