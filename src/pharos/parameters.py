"""The parameter server of a master as a mapping."""
from typing import TYPE_CHECKING, Any, Iterator, MutableMapping

import rosgraph

from pharos.errors import suggest
from pharos.private_rospy.names import global_name
from pharos.private_rospy.parameters import as_stored as as_stored  # for compose, too
from pharos.private_rospy.parameters import changing

if TYPE_CHECKING:
    from pharos.master import Master


class Parameters(MutableMapping[str, Any]):
    """``{global name: value}`` of a master's parameter server; made by :attr:`~pharos.Master.parameters`.

    A name may be a namespace, whose value is a dict of what it holds. Iteration gives all full
    names. Setting a value that the server cannot hold is a ValueError.
    """

    def __init__(self, master: 'Master') -> None:
        self._master = master

    def __getitem__(self, name: str) -> Any:
        return self._call('getParam', self._global_or_there(name))

    def __setitem__(self, name: str, value: Any) -> None:
        if name == '/' and not isinstance(value, dict):
            raise ValueError(f'/ holds all parameters, and is set to a dict of them, not {value!r}')
        full_name = _global(name)
        with changing(full_name):
            self._call('setParam', full_name, as_stored(name, value))

    def __delitem__(self, name: str) -> None:
        if name == '/':
            raise ValueError('/ holds all parameters, and cannot be deleted: set it to {}')
        full_name = self._global_or_there(name)
        with changing(full_name):
            self._call('deleteParam', full_name)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._master.call('getParamNames')))

    def __len__(self) -> int:
        return len(self._master.call('getParamNames'))

    def __contains__(self, name: object) -> bool:
        return bool(self._master.call('hasParam', self._global_or_there(name)))

    def _global_or_there(self, name: Any) -> str:
        """The full form of a name, or one that cannot be a name and that somebody has set all the
        same."""
        try:
            return _global(name)
        except ValueError:
            there = self._master.call('getParamNames')
            if name and any(f'{each}/'.startswith(f'{name}/') for each in there):
                return str(name)  # as rosparam and a YAML file may, or within a node's name
            raise

    def _call(self, method: str, name: str, *args: Any) -> Any:
        try:
            return self._master.call(method, name, *args)
        except rosgraph.MasterError:
            raise KeyError(
                f'no parameter {name} at {self._master.url}{suggest(name, self)}'
            ) from None

    def __repr__(self) -> str:
        return f'<Parameters of {self._master.url}>'


def _global(name: str) -> str:
    return name if name == '/' else global_name(name, 'parameter')  # the namespace of all
