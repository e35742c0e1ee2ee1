"""The pictures of what benchmark/scale has printed: curves, over how many there are."""
import re

import matplotlib.pyplot as plt

from scale_columns import COLUMNS

TITLES = {
    'nodes': 'nodes, in one process',
    'topics': 'topics of one node',
    'twist': 'receivers of twist',
    'image6.2': 'receivers of image6.2',
    'sizes': 'bytes of an image',
}
COUNTED = re.compile(r' *(pharos|rospy) +(\d+) +([-\d. ]+)')
TIMED = re.compile(r' *(\S.*?) +(\d+) +([\d.]+) +[\d.]+ +\d+ +[\d.]+% +[\d.]+')
STYLES = {
    # row: colour, line
    'pharos': ('#0072B2', '-'),
    'pharos default': ('#0072B2', '-'),
    'pharos inline': ('#56B4E9', '-'),
    'pharos, 2 processes': ('#0072B2', '--'),
    'rospy': ('#E69F00', '-'),
    'rospy, 1 process': ('#E69F00', '-'),
    'rospy, 2 processes': ('#E69F00', '--'),
}
OTHER = '#999999', '-'


def read(text):
    """``{section: {row: {number: value}}}``: of nodes and topics a dict of the columns, else the p50
    in microseconds."""
    found, rows = {}, None
    keys = [key for _, key, _, _ in COLUMNS]
    for line in text.splitlines():
        section = [name for name, title in TITLES.items() if line.strip().startswith(title)]
        counted, timed = COUNTED.fullmatch(line), TIMED.fullmatch(line)
        if section:
            rows = found.setdefault(section[0], {})
        elif not line.strip():
            rows = None
        elif rows is not None and counted:
            values = map(float, counted[3].split())
            rows.setdefault(counted[1], {})[int(counted[2])] = dict(zip(keys, values))
        elif rows is not None and timed:
            rows.setdefault(timed[1], {})[int(timed[2])] = float(timed[3])
    return {name: rows for name, rows in found.items() if rows}


def draw_curves(axes, curves, title):
    """A line for each row, with its name and its last value."""
    marks = sorted({number for curve in curves.values() for number in curve})
    for name, curve in curves.items():
        color, style = STYLES.get(name, OTHER)
        axes.plot(list(curve), list(curve.values()), style, color=color, marker='.', label=name)
        last = max(curve)
        text = f'{curve[last]:,.3g}' if curve[last] < 1000 else f'{curve[last]:,.0f}'
        axes.annotate(
            text, (last, curve[last]), (3, 3), textcoords='offset points', fontsize=8, color=color
        )
    axes.set_xscale('log')
    axes.set_yscale('log')
    axes.set_xticks(marks)
    axes.set_xticklabels([f'{mark:g}' if mark < 1e5 else f'{mark / 1e6:g}M' for mark in marks])
    axes.minorticks_off()
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=8, frameon=False)
    for side in 'top', 'right':
        axes.spines[side].set_visible(False)


def draw_nodes(found):
    """What nodes, and topics, take."""
    several = [name for name in ('nodes', 'topics') if name in found]
    columns = {
        'start': 's to start',
        'memory': 'MB of memory',
        'threads': 'threads',
        'descriptors': 'descriptors',
    }
    figure, rows = plt.subplots(
        len(several), len(columns), figsize=(13, 3.2 * len(several)), squeeze=False
    )
    for name, line in zip(several, rows):
        for (key, title), axes in zip(columns.items(), line):
            curves = {
                row: {number: each[key] for number, each in curve.items() if each[key] > 0}
                for row, curve in found[name].items()
            }
            draw_curves(
                axes, {row: curve for row, curve in curves.items() if curve}, f'{name}: {title}'
            )
    figure.tight_layout()
    return figure


def draw_messages(found):
    """How long a message takes, to many and of many bytes."""
    titles = {
        'twist': 'Twist to so many, µs',
        'image6.2': 'image of 6.2 MB to so many, µs',
        'sizes': 'image of so many bytes, µs',
    }
    several = [name for name in titles if name in found]
    figure, (line,) = plt.subplots(1, len(several), figsize=(13, 4), squeeze=False)
    for name, axes in zip(several, line):
        draw_curves(axes, found[name], titles[name])
    figure.tight_layout()
    return figure
