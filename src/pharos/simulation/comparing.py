"""Compare two recordings of virtual time: the first difference of each topic."""
from __future__ import annotations

import itertools
import math
import os
from typing import Any, Iterator

import genpy
import rosbag

MAX_VALUE = 60  # characters of a value in a line


def differences(
    expected: str, actual: str, begin: float, tolerance: float = 0.0, end: float = math.inf
) -> list[str]:
    """Return a line for each topic whose messages differ, the earliest first.

    :param expected: the path of the bag that was recorded before
    :param begin: the ROS time at which the run began, in seconds
    :param tolerance: numbers may differ by so much, and times by so many seconds
    :param end: the second after the begin at which the run has ended; what comes later is told in one line
    """
    found = []
    with rosbag.Bag(expected) as old_bag, rosbag.Bag(actual) as new_bag:
        topics = {topic for bag in (old_bag, new_bag) for topic in bag.get_type_and_topic_info()[1]}
        for topic in topics:
            rows = _compare_topic(old_bag, new_bag, topic, tolerance)
            for number, stamp, text in itertools.islice(rows, 1):
                found.append((stamp.to_sec() - begin, topic, f'#{number} {text}'))
    compared = [row for row in sorted(found) if row[0] < end + 1e-6]
    lines = [f'{second:.3f} s {topic} {text}' for second, topic, text in compared]
    if len(compared) < len(found):
        lines.append(f'{end:.3f} s the run has ended; {expected} goes on: compare runs as long')
    return lines


def _compare_topic(old_bag, new_bag, topic, tolerance) -> Iterator[tuple[int, Any, str]]:
    """Yield the differences of a topic: the number of the message, its time, and a text."""
    bags = old_bag.read_messages([topic]), new_bag.read_messages([topic])
    for number, (old, new) in enumerate(itertools.zip_longest(*bags)):
        if not (old and new):
            text = 'is missing, with all after it' if old else 'is additional'
            yield number, (old or new).timestamp, text
            return
        text = _difference(old.message, new.message, tolerance, '')
        delay = (new.timestamp - old.timestamp).to_sec()
        if abs(delay) > tolerance:
            # virtual times are exact: this one is not late if it comes when the next one should
            if next(bags[0], old).timestamp == new.timestamp:
                text = 'is missing'
            elif next(bags[1], new).timestamp == old.timestamp:
                text = 'is additional'
            elif not text:
                text = f'came {abs(delay):.6f} s {"later" if delay > 0 else "earlier"}'
        if text:
            yield number, old.timestamp, text


def _difference(old, new, tolerance, path) -> str:
    """Return the first field in which two values differ, with both values; '' if they are equal.

    :param path: the place of the values in the message, such as '.linear.x'
    """
    if isinstance(old, genpy.Message) and old._type != new._type:
        return f'{path or "type"}: {old._type} -> {new._type}'
    if isinstance(old, genpy.Message):
        parts = [
            (f'{path}.{name}', getattr(old, name), getattr(new, name)) for name in old.__slots__
        ]
    elif isinstance(old, (list, tuple)) and len(old) == len(new):
        parts = [(f'{path}[{index}]', *pair) for index, pair in enumerate(zip(old, new))]
    else:
        if _is_same(old, new, tolerance):
            return ''
        texts = [' '.join(str(value).split()) for value in (old, new)]
        # from shortly before the place where they differ
        start = max(0, len(os.path.commonprefix(texts)) - MAX_VALUE // 2)
        mark = '...' if start else ''
        return f'{path[1:]}: ' + ' -> '.join(
            mark + each[start : start + MAX_VALUE] for each in texts
        )
    for part_path, old_part, new_part in parts:
        text = _difference(old_part, new_part, tolerance, part_path)
        if text:
            return text
    return ''


def _is_same(old, new, tolerance) -> bool:
    if isinstance(old, genpy.TVal):
        return abs((old - new).to_sec()) <= tolerance
    if isinstance(old, float):
        is_near = abs(old - new) <= tolerance
        return old == new or is_near or math.isnan(old) and math.isnan(new)
    return old == new
