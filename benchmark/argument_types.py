"""What the programs of this folder take as arguments: types for argparse, which prints what they
refuse."""
import argparse


def numbers(text, what='a list as 1,10 of whole numbers'):
    """``'1,10'`` as [1, 10], and ``'6.2e6'`` as [6200000]: whole numbers above 0."""
    try:
        found = [float(number) for number in text.split(',')]
    except ValueError:
        found = [0.0]
    if not all(1 <= each <= 1e9 and each.is_integer() for each in found):
        raise argparse.ArgumentTypeError(f'{text!r} is not {what} from 1 to 1e9')
    return [int(each) for each in found]


def number(text):
    """A whole number above 0."""
    found = numbers(text, 'a whole number')
    if len(found) > 1:
        raise argparse.ArgumentTypeError(f'{text!r} is more than one number')
    return found[0]


def seconds(text):
    """A time above 0."""
    try:
        found = float(text)
    except ValueError:
        found = 0.0
    if not 0 < found < 1e6:
        raise argparse.ArgumentTypeError(f'{text!r} is not a number of seconds above 0')
    return found


def some_of(names):
    """A type for words, separated by commas, which gives the names that have one of them, in their
    order; a whole name gives that one."""

    def chosen(text):
        if text in names:
            return [text]
        words = [word.strip().lower() for word in text.split(',')]
        for word in words:
            if not word or not any(word in name.lower() for name in names):
                raise argparse.ArgumentTypeError(f'no {word!r} in any of: {"; ".join(names)}')
        return [name for name in names if any(word in name.lower() for word in words)]

    return chosen


def each_of(names):
    """A type for names, separated by commas."""

    def chosen(text):
        found = [name.strip() for name in text.split(',')]
        unknown = [name for name in found if name not in names]
        if unknown:
            raise argparse.ArgumentTypeError(f'no {unknown[0]!r}: of {", ".join(names)}')
        return found

    return chosen
