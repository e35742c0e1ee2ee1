"""Raise an exception at each point of a send(), one after another, as the handler of a signal may.

CPython 3.11 calls a handler after a call of C, at the begin of a function, and at a jump back.
usage: points.py SCENARIO; it prints the first point after which a later message does not arrive
"""
import dis
import sys

import pharos
from pharos.testing import until

LOOKS = {'CALL', 'CALL_FUNCTION_EX', 'RESUME', 'JUMP_BACKWARD'}
LOOKS |= {name for name in dis.opname if name.startswith('POP_JUMP_BACKWARD')}
LIMIT = 5  # seconds


class Alarm(Exception):
    pass


class Raiser:
    """Raises an Alarm at the point of that number; ``place`` is None before."""

    def __init__(self, number):
        self.number, self.count, self.place = number, 0, None
        self.former = {}  # frame -> the name of the operation that it has begun last

    def trace(self, frame, event, argument):
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        if event == 'call':
            if frame.f_back in self.former:
                self.former[frame.f_back] = None  # of Python: no look after its return
            self.former[frame] = 'RESUME'
        elif event == 'opcode':
            former = self.former.get(frame)
            self.former[frame] = dis.opname[frame.f_code.co_code[frame.f_lasti]]
            # an exception within Python's own Thread.start() breaks that one
            is_point = former in LOOKS and 'pharos' in frame.f_code.co_filename
            self.count += is_point
            if is_point and self.count == self.number:
                self.place = f'{frame.f_code.co_filename}:{frame.f_lineno}'
                sys.settrace(None)
                while frame:
                    frame.f_trace = None
                    frame = frame.f_back
                raise Alarm
        return self.trace

    def run(self, block):
        try:
            sys.settrace(self.trace)
            try:
                block()
            finally:
                sys.settrace(None)
        except (Alarm, pharos.PharosError):
            pass


def create(inline):
    """Return a channel to a new node, what that hears, and the node."""
    global serial
    serial += 1
    heard, ear = [], master.create(pharos.BlockNode, f'ear{serial}')
    topic = f'/words{serial}'
    ear.interested_in(topic, 'std_msgs/String', lambda m: heard.append(m.data), inline=inline)
    return mouth.output_channel(topic, 'std_msgs/String'), heard, ear


serial = 0
scenario = sys.argv[1]
master = pharos.Master()
mouth = master.create(pharos.BlockNode, 'mouth')
out, heard, ear = create(scenario == 'inline')
if scenario != 'first':
    out.send(data='first')
number, raiser = 0, None
while number == 0 or raiser.place:
    number += 1
    raiser = Raiser(number)
    raiser.run(lambda: out.send(data='cut'))
    later = f'later {number}'
    out.send(data=later)
    try:
        until(lambda: later in heard, LIMIT)
    except TimeoutError:
        sys.exit(f'a queue sleeps after an exception at {raiser.place}')
    if scenario == 'first':
        ear.stop()
        out.close()
        out, heard, ear = create(False)
print(number, 'points')
