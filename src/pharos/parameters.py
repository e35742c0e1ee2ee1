"""The parameter server of a master as a mapping."""
import collections.abc

import rosgraph

from pharos.errors import suggest
from pharos.private_rospy.names import global_name
from pharos.private_rospy.parameters import carried


class Parameters(collections.abc.MutableMapping):
    """``{global name: value}`` of a master's parameter server; made by :attr:`Master.parameters`.

    A name may be a namespace, whose value is a dict of what it holds. Iteration gives all full
    names. Setting a value that the server cannot hold is a ValueError.
    """

    def __init__(self, master):
        self._master = master

    def __getitem__(self, name):
        return self._call('getParam', self._global_or_there(name))

    def __setitem__(self, name, value):
        self._call('setParam', _global(name), carried(name, value))

    def __delitem__(self, name):
        self._call('deleteParam', self._global_or_there(name))

    def __iter__(self):
        return iter(sorted(self._master._ask('getParamNames')))

    def __len__(self):
        return len(self._master._ask('getParamNames'))

    def __contains__(self, name):
        name = self._global_or_there(name)
        with self._master._reached():
            return self._master._api().hasParam(name)

    def _global_or_there(self, name):
        """The full form of a name, or one that cannot be a name and that somebody has set all the
        same."""
        try:
            return _global(name)
        except ValueError:
            if name in self._master._ask('getParamNames'):  # as rosparam and a YAML file may
                return name
            raise

    def _call(self, method, name, *args):
        with self._master._reached():
            try:
                return getattr(self._master._api(), method)(name, *args)
            except rosgraph.MasterError:
                raise KeyError(
                    f'no parameter {name} at {self._master.url}{suggest(name, self)}'
                ) from None

    def __repr__(self):
        return f'<Parameters of {self._master.url}>'


def _global(name):
    return name if name == '/' else global_name(name, 'parameter')  # the namespace of all
