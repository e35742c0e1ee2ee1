"""Look at what runs at a master; loaded only when used."""
import argparse
import os
import re
import sys

import rosgraph

from pharos.errors import PharosError


def parser(about):
    """Return a parser of arguments that shows the text as it is."""
    return argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def run(command):
    """Run a command with the program's arguments, and return the exit status."""
    try:
        command(rosgraph.myargv()[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # by `| head`; the exit flushes what is left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (PharosError, ValueError, OSError, re.error) as error:
        print(f'{command.__name__}: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    return 0
