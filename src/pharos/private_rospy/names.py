"""ROS names: what can be one, and how a name that is resolved already passes through rospy as it
is."""
import itertools
import os
import re
import reprlib
import time

import rosgraph.names

# rosgraph.names.is_legal_name, which tells no position; a name also begins with a letter, as
# rosgraph's comment has it
_LEGAL = re.compile(r'(?:~/?|/)?(?:(?:[A-Za-z]|(?<=[~/])_)\w*(?:/\w+)*)?', re.ASCII)
_EMPTY = '', '/', '~', '~/'
NAME_LIMIT = 1000  # characters of a name, also in what other nodes send
NODE_LIMIT = 250  # of that of a node of ours: its log file is named after it
_EXAMPLES = {'node': 'driver', 'parameter': 'rate', 'namespace': 'left'}
_numbers = itertools.count(1)  # of the anonymous nodes of this process


def check_name(name, what, private=False, base=False, limit=NAME_LIMIT):
    """``name`` if it can be one, else ValueError with a caret under the first bad character.

    :param what: the name is for, 'topic' for example; that of a 'node' ends in a part that begins
        with a letter
    :param private: whether '~name' is one, since a node is there that it is private to
    :param base: whether it is one part only, without a namespace
    :param limit: how many characters it has at the most
    """
    if not isinstance(name, str):
        raise ValueError(f'a {what} name is a string, not {name!r}')
    if name in _EMPTY:
        last = _EXAMPLES.get(what, 'image')
        raise ValueError(
            f"a {what} name is one such as '{last if base else '/robot1/' + last}', not {name!r}"
        )
    if len(name) > limit:
        raise ValueError(
            f'a {what} name has {limit} characters at the most, and {reprlib.repr(name)} has'
            f' {len(name)}'
        )
    at = _bad_character(name, what == 'node', private, base)
    if at is None:
        return name
    allowed = 'letters, digits and _, beginning with a letter' + (
        '' if base else '; parts are joined by /'
    )
    if name.startswith('~') and not private:
        allowed += '; a name with ~ is private to a node, and can be given to a node alone'
    raise ValueError(f'{name!r} cannot be a {what} name ({allowed}):\n  {name}\n  {" " * at}^')


def _bad_character(name, is_node, private, base):
    """Where the first bad character is, None if there is none."""
    if name[0] == '~' and not private:
        return 0
    end = _LEGAL.match(name).end()
    rest = name[end:]
    if base and '/' in name[:end]:
        return name.index('/')
    if rest == '/' and not is_node and name[:end].strip('~/'):  # rospy takes it away
        return None
    if rest:
        return end + 1 if rest[0] == '/' and len(rest) > 1 else end
    last = name.rpartition('/')[2].lstrip('~')
    return len(name) - len(last) if is_node and not last[0].isalpha() else None


def global_name(name, what):
    """The full form of a name that no node is there to resolve; ValueError if it cannot be one."""
    return rosgraph.names.resolve_name(check_name(name, what), '/')


def unique_name(base):
    """The name of an anonymous node, as rospy makes it, which would give the same to those that one
    process makes within a millisecond."""
    return f'{base}_{os.getpid()}_{int(time.time() * 1000)}{next(_numbers)}'


class Resolved(str):
    """A name that rospy is to take as it is: it is resolved and remapped, and would be remapped
    once more."""
