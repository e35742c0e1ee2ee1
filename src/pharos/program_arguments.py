"""What ROS programs are told when they start: arguments, remappings, parameters of their nodes."""
import math
import numbers
import os
from typing import TYPE_CHECKING, Any, Dict, List, Mapping, Optional, Sequence

import rosgraph.names
import yaml

from pharos.parameters import as_stored
from pharos.private_rospy.names import check_name

if TYPE_CHECKING:
    from pharos.master import Master


def arguments_of(
    args: Sequence[object], name: Optional[str], remap: Optional[Mapping[str, str]]
) -> List[str]:
    """The arguments of a program, as rosrun takes them; see :meth:`Master.run`.

    :raises TypeError, ValueError: if one of them cannot be one
    """
    for argument in args:
        if not isinstance(argument, (str, numbers.Number, os.PathLike)):
            raise TypeError(
                f'the arguments of a program are texts or numbers, not {argument!r}: each is given'
                ' by itself'
            )
    mappings: Dict[str, object] = {}
    for left, right in _checked('remap', remap).items():
        if not (isinstance(left, str) and left.startswith('__')):  # else it is no name, as __ns
            check_name(left, 'remapped', private=True)
            check_name(right, 'remapped', private=True)
        mappings[left] = right
    if name is not None:
        mappings['__name'] = check_name(name, 'node', base=True)
    return [*map(str, args), *(f'{left}:={right}' for left, right in mappings.items())]


def parameters_of(params: Optional[Mapping[str, object]]) -> Dict[str, Any]:
    """``{name: value}`` of the private parameters of a program's node, given as 'rate' or '~rate'; see
    :meth:`Master.run`.

    :raises TypeError, ValueError: if one of them cannot be one
    """
    parameters = {}
    for name, value in _checked('params', params).items():
        own = name[1:] if isinstance(name, str) and name.startswith('~') else name
        if check_name(own, 'parameter').startswith('/'):
            raise ValueError(
                f'{name!r} is not private to the node: set it by master.parameters[{name!r}]'
            )
        parameters[own] = as_stored(f'~{own}', value)
    return parameters


def set_parameters(
    master: 'Master', name: str, remap: Optional[Mapping[str, str]], parameters: Dict[str, Any]
) -> None:
    """Set the private parameters of a node that is to start, as roslaunch does.

    :raises MasterUnreachableError: if there is no answer
    """
    namespace = (remap or {}).get('__ns') or rosgraph.names.get_ros_namespace()
    node = rosgraph.names.ns_join(rosgraph.names.make_global_ns(namespace), name)
    for parameter, value in parameters.items():
        master.parameters[rosgraph.names.ns_join(node, parameter)] = value


def parameter_arguments(path: str, parameters: Dict[str, Any]) -> List[str]:
    """Arguments by which a program sets them itself: rospy reads them as YAML, and roscpp as numbers,
    truth values or text.

    :param path: the program's
    :raises ValueError: if a value would become another one
    """
    texts, is_python = {}, _is_python(path)
    for name, value in parameters.items():
        texts[name] = text = _as_yaml(value) if is_python else str(value)
        if not (is_python or _survives_roscpp(value)) or rosgraph.names.REMAP in text:
            raise ValueError(
                f'the parameter {name} of {path} cannot be given as {value!r}: on a command line it'
                ' would become something else. Give the program a name=, and it is set on the'
                ' parameter server'
            )
    return [f'_{name}:={text}' for name, text in texts.items()]


def _checked(what: str, given: Optional[Mapping[str, Any]]) -> Mapping[str, Any]:
    if not isinstance(given, (Mapping, type(None))):
        raise TypeError(f'{what} is a dict by name, not {given!r}')
    return given or {}


def _is_python(path: str) -> bool:
    try:
        with open(path, 'rb') as file:
            first = file.readline(200)
    except OSError:  # it may be run, and not read
        return False
    return first.startswith(b'#!') and b'python' in first


def _as_yaml(value: Any) -> str:
    if isinstance(value, str) and value == value.strip() and _read_by_rospy(value) == value:
        return value  # without quotes
    text: str = yaml.safe_dump(value, default_flow_style=True, width=math.inf)
    return text[: -len('\n...\n')] if text.endswith('\n...\n') else text.rstrip('\n')


def _read_by_rospy(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None


def _survives_roscpp(value: Any) -> bool:
    if not isinstance(value, str):
        return isinstance(value, (bool, int, float))
    try:
        float(value)
        return False
    except ValueError:
        return bool(value) and value == value.strip() and value.lower() not in ('true', 'false')
