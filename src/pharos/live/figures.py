"""Numbers, rates and sizes as text: for sentences, and for columns, which have room for less."""


def number_text(value: float) -> str:
    """A number with three digits that matter, and never an exponent."""
    if abs(value) >= 100:
        return f'{value:.0f}'
    return f'{value:.3g}' if abs(value) >= 1e-4 or not value else f'{value:.6f}'


def rate_text(rate: float) -> str:
    """A number of messages a second: '29.8 Hz'."""
    return f'{number_text(rate)} Hz'


def size_text(count: float) -> str:
    """A number of bytes as people read it: '6.2 MB'; units are thousands, as rostopic has them."""
    for unit in ('B', 'kB', 'MB'):
        if abs(count) < 999.5:
            return f'{number_text(count)} {unit}'
        count /= 1000
    return f'{number_text(count)} GB'


def short_number(value: float) -> str:
    """A number in at most five characters: 999, 1.2k, 35M."""
    for unit in ('', 'k', 'M'):
        if value < 999.5:
            return f'{value:.1f}{unit}' if unit and value < 9.95 else f'{value:.0f}{unit}'
        value /= 1000
    return f'{value:.1f}G'


def short_rate(value: float) -> str:
    """Likewise, but small ones to a tenth: 0.3, 29.8, 1.2k."""
    return f'{value:.1f}' if value < 99.95 else short_number(value)
