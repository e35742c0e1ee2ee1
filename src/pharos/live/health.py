"""The facts on a run that ``Node.health()`` and ``rosrun pharos top`` show."""
from __future__ import annotations

import collections
import re
import sys
import time
from contextlib import suppress
from typing import Any


def facts_of(run: Any) -> dict[str, Any]:
    """Return the facts of :meth:`Node.health`, but for the master's."""
    queues = list(run.callback_queue.order.queues)
    # read once: a callback may end meanwhile
    begin_times = [queue.begin_time for queue in queues]
    begin_times = [begin_time for begin_time in begin_times if begin_time]
    return {
        'kind': type(run.node).__name__,
        'connections': dict(
            collections.Counter(row[3] for row in run.topic_manager.get_pub_sub_info())
        ),
        'dropped': sum(getattr(each, 'dropped', 0) for each in run.open_endpoints(object)),
        'errors': run.failures.total,
        'threads': len(run.threads),
        'cpu_seconds': round(_cpu_seconds(run), 3),
        'souls': len(run.souls),
        'ended_souls': list(run.ended_souls),
        'callback_seconds': time.perf_counter() - min(begin_times) if begin_times else 0.0,
        'waiting': sum(len(queue.jobs) for queue in queues),
        'lock': _lock_text(),
    }


def _lock_text():
    """Return a text if an import has turned the interpreter's lock on, '' if none has."""
    # a free-threaded Python warns of it, and keeps the warning here; others have no such warning
    warnings = getattr(sys.modules['_frozen_importlib'], '__warningregistry__', '')
    match = re.search(r"\(GIL\) .* module '(.+?)'", str(warnings))
    return f'{match[1]} has turned the lock on' if match else ''


def _cpu_seconds(run):
    """Return the CPU time of the node's threads."""
    seconds = run.ended_cpu_seconds
    for thread in list(run.threads):
        with suppress(OSError, TypeError):  # the thread has ended, or not begun
            # Linux's number of the clock; pthread_getcpuclockid() reads the memory of a thread that ends
            seconds += time.clock_gettime(~thread.native_id << 3 | 6)
    return seconds
