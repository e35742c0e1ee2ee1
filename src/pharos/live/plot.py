"""Numbers of a topic over time, collected from when they are asked for and drawn by matplotlib."""
import collections
import io
import os
import time
from typing import Any, Callable, Deque, Dict, List, Optional, Tuple, Union

import genpy

from pharos.channel import InputChannel
from pharos.errors import PharosError, missing
from pharos.live.colors import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from pharos.live.watching import create_looker
from pharos.messages.numeric_field import numeric_field
from pharos.probe import Look
from pharos.seconds import check_seconds

KEPT = 100000  # messages that a plot is made of, the newest
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
        self._readers = list(readers.values())
        self._rows: Deque[Tuple[float, List[Optional[float]]]] = collections.deque(maxlen=KEPT)
        self._looker = create_looker(channel.node.master)
        self._begin = time.monotonic()
        try:
            self._looker.interested_in(
                channel.topic, channel.message_class, self._collect, from_=channel.from_
            )
        except BaseException:
            self.close()
            raise

    def _collect(self, message: genpy.Message, channel: InputChannel) -> None:
        self._rows.append(
            (time.monotonic() - self._begin, [read(message) for read in self._readers])
        )

    @property
    def times(self) -> List[float]:
        """When each message came, in seconds since the beginning."""
        return [when for when, _ in list(self._rows)]

    @property
    def values(self) -> Dict[str, List[Optional[float]]]:
        """The values of each field."""
        rows = [values for _, values in list(self._rows)]
        return {field: [row[at] for row in rows] for at, field in enumerate(self.fields)}

    def wait(self, seconds: float) -> 'Plot':
        """Collect for so many seconds more; returns this plot.

        :raises NodeStoppedError: if the nodes stop meanwhile, or the one whose thread this is
        """
        seconds = check_seconds('seconds', seconds, above=0)
        Look().wait_out(self._looker, seconds)
        return self

    def close(self) -> None:
        """Collect no more; what was collected stays. Harmless when done twice."""
        if self._looker.is_running:
            self._looker.stop()

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
        rows = list(self._rows)
        times = [when for when, _ in rows]
        for at, field in enumerate(self.fields):
            color, dash = _LINES[at % len(_LINES)]
            values = [float('nan') if row[at] is None else row[at] for _, row in rows]
            marker = '.' if len(rows) <= 50 else ''
            axes.plot(times, values, color=color, linestyle=dash, marker=marker, label=field)
        axes.set_xlabel('seconds')
        axes.set_title(f'{self.topic} ({self.type}): {len(rows)} messages', fontsize='medium')
        axes.grid(color='#E0E0E0')
        axes.legend(loc='best')
        return figure

    def save(self, path: Union[str, 'os.PathLike[str]']) -> None:
        """Draw it into a file; the suffix of ``path`` says how: .png, .svg, .pdf and what else
        matplotlib knows.

        :raises ValueError: if matplotlib knows no such suffix
        :raises PharosError: if the file cannot be written, or matplotlib is not installed
        """
        try:
            self.figure().savefig(path)
        except OSError as error:
            raise PharosError(f'{os.fspath(path)} cannot be written: {error.strerror}') from error

    def _repr_png_(self) -> bytes:
        """The picture in Jupyter."""
        file = io.BytesIO()
        self.figure().savefig(file, format='png')
        return file.getvalue()

    def __repr__(self) -> str:
        state = 'collecting' if self._looker.is_running else 'closed'
        fields = ', '.join(self.fields)
        return f'<Plot of {fields} of {self.topic}: {len(self._rows)} messages, {state}>'


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
        publishers = channel.node.master.topic(channel.topic).publishers
        raise TimeoutError(
            f'no message came on {channel.topic} within {seconds:g} s, which'
            f' {", ".join(publishers) or "nobody"} publishes'
        )
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
