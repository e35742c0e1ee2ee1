"""Prints what benchmark/channels measured: ``slices`` is ``{(key, row name): [Slice of each
round]}``."""
import statistics
import textwrap


class Figures:
    """A row's figures over all rounds; times in microseconds."""

    def __init__(self, slices):
        took = sorted(1e6 * value for each in slices for value in each.took)
        self.p50, self.p95, self.p99 = (_quantile(took, part) for part in (0.5, 0.95, 0.99))
        self.rate = statistics.median(each.received / each.duration for each in slices)
        sent, received = sum(each.sent for each in slices), sum(each.received for each in slices)
        self.lost = 100 * (sent - received) / sent
        self.cpu = 1e6 * sum(each.cpu for each in slices) / max(received, 1)


def _quantile(ordered, part):
    return ordered[int(part * (len(ordered) - 1))] if ordered else float('nan')


def _ratio(value, first):
    return '' if first is None else '%.3g' % float('%.2g' % (value / first)) if first else '-'


def time_text(value):
    """Microseconds, in few digits."""
    return '%.*f' % (2 if value < 10 else 1 if value < 100 else 0, value)


def indented(text):
    """In lines of their own."""
    return '\n' + textwrap.fill(text, 110, initial_indent=' ' * 4, subsequent_indent=' ' * 5)


def print_ways(names, messages, receivers, slices):
    """The table."""
    print(
        '%-25s | %-29s | %-23s | %s'
        % ('', 'latency at 100 Hz, us', 'latency flat out, us', 'flat out')
    )
    heads = (
        ('p50', 'ratio', 'p99', 'CPU'),
        ('p50', 'ratio', 'p99'),
        ('received/s', 'ratio', 'lost', 'CPU us'),
    )
    print(
        '%-25s | %7s %7s %6s %6s | %7s %7s %7s | %10s %7s %6s %6s'
        % ('', *heads[0], *heads[1], *heads[2])
    )
    for message in messages:
        for count in receivers:
            print('-' * 118)
            print('%s, %d receiver%s' % (message, count, 's' * (count > 1)))
            first = None
            for name in names:
                found = [slices.get(((message, count, mode), name)) for mode in ('paced', 'flat')]
                if None in found:
                    continue
                paced, flat = map(Figures, found)
                first = first or (paced, flat)
                print(
                    '  %-23s | %7s %7s %6s %6s | %7s %7s %7s | %10s %7s %5.1f%% %6s'
                    % (
                        name,
                        time_text(paced.p50),
                        _ratio(paced.p50, first[0].p50),
                        time_text(paced.p99),
                        time_text(paced.cpu),
                        time_text(flat.p50),
                        _ratio(flat.p50, first[1].p50),
                        time_text(flat.p99),
                        '%.0f' % flat.rate,
                        _ratio(flat.rate, first[1].rate),
                        flat.lost,
                        time_text(flat.cpu),
                    )
                )
                if paced.lost:
                    print(f"  {'':23} | {paced.lost:.2g}% lost")


def print_special(names, slices):
    """The small tables."""
    _print_small(
        'twist at 100 Hz, the publisher busy with Python code in between',
        names,
        slices,
        ('twist', 'busy'),
    )
    _print_small(
        'image6.2 at 30 Hz from another process to 10 receivers',
        names,
        slices,
        ('image6.2', 'sharing'),
    )
    for message in ('twist', 'image0.9'):
        _print_small(f'{message} flat out, queue_size=10', names, slices, (message, 'short'))


def _print_small(title, names, slices, key):
    figures = {name: Figures(slices[key, name]) for name in names if (key, name) in slices}
    if figures:
        print('\n%-58s %8s %8s %8s %10s %6s' % (title, 'p50', 'p95', 'p99', 'received/s', 'lost'))
        for name, each in figures.items():
            print(
                '  %-56s %8s %8s %8s %10.0f %5.1f%%'
                % (
                    name,
                    time_text(each.p50),
                    time_text(each.p95),
                    time_text(each.p99),
                    each.rate,
                    each.lost,
                )
            )


def print_aims(slices):
    """What was aimed at, and whether it was reached in this run."""
    figures = {key: Figures(value) for key, value in slices.items()}

    def of(row, *key):
        return figures.get((key, row))

    aims = []

    def aim(text, left, right, unit='%.1f'):
        """left is to be below right"""
        aims.append((text, left <= right, unit % left, unit % right))

    for message in ('twist', 'image6.2'):
        paced, flat = (message, 1, 'paced'), (message, 1, 'flat')
        direct, queue, nodelets = (
            of(row, *paced) for row in ('direct call', 'SimpleQueue, 2 threads', 'C++ nodelets')
        )
        inline, shared, default = (
            of(row, *paced) for row in ('pharos inline', 'pharos inline, shared', 'pharos default')
        )
        if of('pharos inline', *flat):
            aim(f'{message}, inline, flat out: 3 us', of('pharos inline', *flat).p50, 3.0)
        if direct and inline:
            aim(f'{message}, inline, 100 Hz: 4 direct calls', inline.p50, 4 * direct.p50)
        if direct and shared:
            aim(f'{message}, inline and shared, 100 Hz: 3 direct calls', shared.p50, 3 * direct.p50)
        if default and nodelets:
            aim(f'{message}, default, 100 Hz: below nodelets', default.p50, nodelets.p50)
        if default and queue:
            aim(f'{message}, default, 100 Hz: 1.5 bare hand-overs', default.p50, 1.5 * queue.p50)
        ten = [of(row, message, 10, 'paced') for row in ('pharos default', 'C++ nodelets')]
        if all(ten):
            aim(
                f'{message}, default, 10 receivers, 100 Hz: 1.5 nodelets',
                ten[0].p50,
                1.5 * ten[1].p50,
            )
    busy = of('pharos default', 'twist', 'busy')
    if busy:
        aim('busy publisher, default: p95 150 us', busy.p95, 150.0)
    flat = of('pharos default', 'twist', 1, 'flat')
    if flat:
        aim('twist, default, flat out: none lost', flat.lost, 0.0)
        aim('twist, default, flat out: at least so many a second', -flat.rate, -200000.0, '%.0f')
        if of('C++ nodelets', 'twist', 1, 'flat'):
            aim(
                '... and more than nodelets',
                -flat.rate,
                -of('C++ nodelets', 'twist', 1, 'flat').rate,
                '%.0f',
            )
    for message in ('twist', 'image0.9'):
        if of('pharos default', message, 'short'):
            aim(
                f'{message}, queue_size=10, flat out: 25 % lost',
                of('pharos default', message, 'short').lost,
                25.0,
            )
    for message in ('twist', 'image0.9', 'image6.2'):
        ours = of('pharos, 2 processes', message, 1, 'paced')
        if ours and of('rospy, 2 proc., tuned', message, 1, 'paced'):
            aim(
                f'{message} over TCPROS, 100 Hz: rospy, tuned, +5 %',
                ours.p50,
                1.05 * of('rospy, 2 proc., tuned', message, 1, 'paced').p50,
            )
        if ours and of('rospy, 2 processes', message, 1, 'paced'):
            aim(
                f"{message} over TCPROS, 100 Hz: rospy's defaults",
                ours.p50,
                of('rospy, 2 processes', message, 1, 'paced').p50,
            )
    camera = [
        of(row, 'image6.2', 'sharing') for row in ('pharos, 2 pr., sharing', 'rospy, 2 processes')
    ]
    if all(camera):
        text = 'camera elsewhere, 10 sharers, 30 Hz'
        aim(f"{text}: 1.3 rospy's callbacks", camera[0].p50, 1.3 * camera[1].p50)
        aim(f'{text}: none lost', camera[0].lost, 0.0)
    if aims:
        print('\n%-58s %10s %10s' % ('aims', 'here', 'limit'))
        for text, reached, left, right in aims:
            print(
                '  %-56s %10s %10s  %s'
                % (text, left.lstrip('-'), right.lstrip('-'), 'reached' if reached else 'MISSED')
            )
