"""The columns that benchmark/scale prints of nodes and topics: (heading, key, width, form)."""
COLUMNS = (
    # heading, key, width, form
    ('start, s', 'start', 9, '%.2f'),
    ('stop, s', 'stop', 8, '%.2f'),
    ('memory, MB', 'memory', 11, '%.1f'),
    ('threads', 'threads', 8, '%d'),
    ('descriptors', 'descriptors', 12, '%d'),
    ('idle CPU, %', 'cpu', 12, '%.2f'),
    ('asked/start', 'asked to start', 12, '%d'),
    ('asked/s', 'requests', 8, '%.1f'),
    ('kB/s', 'bytes', 7, '%.1f'),
    ('master, %', 'master', 10, '%.2f'),
)
