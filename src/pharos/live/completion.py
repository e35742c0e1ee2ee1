"""Completion: the names of the graph, the types and the fields that a line of Python asks for.

:func:`completions` is for any program, :func:`equip` has IPython use it. It asks the master, for
:data:`LIMIT` at the most; where that does not answer there is nothing to complete.
"""
import ast
import functools
import importlib
import inspect
import re
import time
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Tuple

import rosgraph.names
import rospkg

from pharos import messages
from pharos.blocks import attempt
from pharos.master import Master
from pharos.messages.numeric_field import numeric_paths
from pharos.node import Node
from pharos.output_channel import OutputChannel
from pharos.service import Service

LIMIT = 0.5  # seconds that the master may take
FRESH = 1.0  # seconds for which its answer holds

_TOKEN = re.compile(
    r"""(?P<string>'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")|(?P<quote>['"])|(?P<open>[(\[{])"""
    r"""|(?P<close>[)\]}])|(?P<comma>,)|(?P<comment>\#.*)""",
    re.DOTALL,
)
_DOTTED = re.compile(r'[A-Za-z_][\w.]*$')
_KEYWORD = re.compile(r'\s*([A-Za-z_]\w*)\s*=(?!=)\s*')


class Place(NamedTuple):
    """Where code ends: in the arguments of a call, or in a subscript."""

    bracket: str  # '(', or '[' of a subscript
    function: str  # the dotted name before it
    before: str  # the arguments before the last
    argument: str  # the last, as far as it is typed, without the string that it ends in
    string: Optional[str]  # that string, as far as it is typed; None where it ends in none

    @property
    def word(self) -> str:
        """What is to be completed."""
        return self.argument.strip() if self.string is None else self.string


def place_of(code: str) -> Optional[Place]:
    """Where the code ends; None if that is in no bracket after a name."""
    brackets: List[Tuple[int, int]] = []  # where each that is open is, and its last argument begins
    string, end = None, len(code)
    for token in _TOKEN.finditer(code):
        if token.lastgroup == 'quote':
            string, end = code[token.end() :], token.start()
            break
        if token.lastgroup == 'open':
            brackets.append((token.start(), token.end()))
        elif token.lastgroup == 'close' and brackets:
            brackets.pop()
        elif token.lastgroup == 'comma' and brackets:
            brackets[-1] = brackets[-1][0], token.end()
    if not brackets:
        return None
    opening, begin = brackets[-1]
    function = _DOTTED.search(code[:opening])
    if function is None or code[opening] == '{':
        return None
    before = code[opening + 1 : begin]
    return Place(code[opening], function[0], before, code[begin:end], string)


def completions(code: str, names: Mapping[str, Any]) -> List[str]:
    """What the word can be with which a piece of Python code ends, as far as it is typed.

    >>> completions("me.send_to('/turtle1/c", {'me': node})
    ['/turtle1/cmd_vel', '/turtle1/command_velocity']

    :param names: the names that the code knows; ``me`` and ``master`` among them stand for those
        that it does not
    :returns: whole words; keywords with a '=' at their end. None where the code is no call of a
        method of this package, or the master does not answer in time
    """
    place = place_of(code)
    if place is None:
        return []
    found: List[str] = attempt(functools.partial(_words, place, names), [])
    return [word for word in found if word.startswith(place.word)]


def _words(place: Place, names: Mapping[str, Any]) -> List[str]:
    return _Call(place, names).words()


class _Call:
    """The call, or subscript, that code ends in."""

    def __init__(self, place: Place, names: Mapping[str, Any]) -> None:
        self.place = place
        path, _, self.name = place.function.rpartition('.')
        self.owner = _owner(path, self.name, names)
        self.function: Any = None  # of a subscript
        if place.bracket == '(':
            self.function = _static_value(self.owner, self.name) if path else names[self.name]
        master = self.owner if isinstance(self.owner, Master) else None
        self.master: Any = master or getattr(self.owner, 'master', None) or names.get('master')
        self.node = self.owner if isinstance(self.owner, Node) else None
        self.positional, self.keywords = _constants(place.before)

    def words(self) -> List[str]:
        """What the last argument can be."""
        if self.place.bracket == '[':
            is_parameters = isinstance(self.owner, Master) and self.name == 'parameters'
            return self._names(_parameters) if is_parameters else []
        if not _is_of_this_package(self.owner, self.name, self.function):
            return []
        if self.place.string is None:
            is_word = re.fullmatch(r'\s*\w*', self.place.argument)
            return self._keywords() if is_word else []
        kind = self.kind()
        if kind is _fields:
            return list(numeric_paths(self.owner.message_class))
        return self._names(kind) if kind else []

    def kind(self) -> Optional[Callable[[Master], List[str]]]:
        """What the string that is typed names; None for what is no name."""
        parameter = self._parameter()
        return _KINDS.get((self.name, parameter)) or _KINDS.get(('', parameter))

    def _parameter(self) -> str:
        """The name of the parameter that the last argument is for; '' where that cannot be told."""
        keyword = _KEYWORD.match(self.place.argument)
        if self.place.argument[keyword.end() if keyword else 0 :].strip():
            return ''  # the string is a part of an expression
        if keyword:
            return keyword[1]
        parameters = list(inspect.signature(self.function).parameters.values())
        for number, parameter in enumerate(parameters):
            if number == len(self.positional) or parameter.kind is parameter.VAR_POSITIONAL:
                return parameter.name
        return ''

    def _names(self, kind: Callable[[Master], List[str]]) -> List[str]:
        """The names of a kind, written as the word that is to be completed is."""
        names, word = kind(self.master), self.place.word
        if kind not in _RELATIVE or not word or word.startswith('/'):
            return names
        space, begin = '/', ''
        if self.node is not None:
            space = rosgraph.names.namespace(self.node.name)
            if word.startswith('~'):
                space, begin = self.node.name + '/', '~'
        return [begin + name[len(space) :] for name in names if name.startswith(space)]

    def _keywords(self) -> List[str]:
        """The fields that the call fills, but for those that it has already."""
        cls = self._message_class()
        fields = messages.fields_of(cls) if cls is not None else []
        # those that the call has keywords for go into a dict
        taken = {*self.keywords, *inspect.signature(self.function).parameters}
        return [f'{name}=' for name, _ in fields if name not in taken]

    def _message_class(self) -> Any:
        """The class of the message, or request, that the call fills."""
        if isinstance(self.owner, Service) and self.name == 'call':
            return self.owner.service_class._request_class
        if isinstance(self.owner, OutputChannel) and self.name == 'send':
            return self.owner.message_class
        if self.node is None or self.name != 'send_to' or not self.positional:
            return None
        typed_as = self.keywords.get('typed_as')
        topic = self.node.current_run.resolve(self.positional[0], 'topic')
        for channel in self.node.channels:
            if channel.topic == topic and not typed_as:
                return channel.message_class
        return messages.message_class(typed_as or _topic_types(self.master)[topic])


def _owner(path: str, method: str, names: Mapping[str, Any]) -> Any:
    """What a method is called on; where that is not known, such as ``self``, a node or master that
    has such a method, or None."""
    if not path:
        return None
    first, *rest = path.split('.')
    if first not in names:
        likely = (names.get('me'), names.get('master'))
        return next((each for each in likely if hasattr(type(each), method)), None)
    value = names[first]
    for name in rest:
        value = _static_value(value, name)
    return value


def _static_value(owner: Any, name: str) -> Any:
    """An attribute, but for properties, which may ask the whole graph."""
    if isinstance(inspect.getattr_static(type(owner), name, None), property):
        raise AttributeError(name)
    return getattr(owner, name)


def _is_of_this_package(owner: Any, name: str, function: Any) -> bool:
    """Whether it is a function of this package, or a method that overrides one."""
    classes = [cls for cls in type(owner).__mro__ if name in vars(cls)]
    modules = [getattr(each, '__module__', None) or '' for each in (*classes, function)]
    return any(module.partition('.')[0] == 'pharos' for module in modules)


def _constants(arguments: str) -> Tuple[List[Any], Dict[str, Any]]:
    """The positional arguments, and the others by their keywords; None for what is no constant."""
    tree = ast.parse(f'f({arguments})', mode='eval')
    call: Any = tree.body

    def value(node: ast.AST) -> Any:
        return getattr(node, 'value', None) if isinstance(node, ast.Constant) else None

    positional = [value(node) for node in call.args]
    return positional, {each.arg: value(each.value) for each in call.keywords if each.arg}


# -- what there is


class _Recent:
    """What a master has answered, for as long as that is fresh."""

    def __init__(self) -> None:
        self._answers: Dict[Tuple[str, str], Tuple[float, Any]] = {}

    def __call__(self, master: Master, method: str) -> Any:
        """The answer to one of the questions without arguments; an empty one where none comes in
        time.

        A prompt asks several times for one press of a key, and has not to wait each time.
        """
        key = master.url, method
        until, answer = self._answers.get(key, (0.0, None))
        if time.monotonic() > until:
            answer = attempt(lambda: master.call(method, timeout=LIMIT), [])
            self._answers[key] = time.monotonic() + FRESH, answer
        return answer


_ask = _Recent()


def _topics(master: Master) -> List[str]:
    return sorted({name for kind in _ask(master, 'getSystemState')[:2] for name, _ in kind})


def _services(master: Master) -> List[str]:
    return sorted({name for kind in _ask(master, 'getSystemState')[2:] for name, _ in kind})


def _nodes(master: Master) -> List[str]:
    state = _ask(master, 'getSystemState')
    return sorted({node for kind in state for _, nodes in kind for node in nodes})


def _topic_types(master: Master) -> Dict[str, str]:
    return dict(_ask(master, 'getTopicTypes'))


def _parameters(master: Master) -> List[str]:
    return sorted(_ask(master, 'getParamNames'))


@functools.lru_cache(maxsize=4)
def _types(kind: str, minute: int) -> List[str]:
    """Those known in that minute: to look through all packages for each press of a key takes too
    long."""
    return sorted(messages.known_types(kind))


def _message_types(master: Master) -> List[str]:
    return _types('msg', int(time.monotonic() // 60))


def _service_types(master: Master) -> List[str]:
    return _types('srv', int(time.monotonic() // 60))


def _packages(master: Master) -> List[str]:
    return sorted(rospkg.RosPack().list())


def _fields(master: Master) -> List[str]:
    """Paths of fields, of which only the call can tell the message."""
    return []


_RELATIVE = {_topics, _services, _nodes, _parameters}  # may be typed in a node's namespace

#: (method or function, its parameter) -> the names that there are for it; '' stands for all others
_KINDS: Dict[Tuple[str, str], Callable[[Master], List[str]]] = {
    ('', 'topic'): _topics,
    ('', 'typed_as'): _message_types,
    ('', 'from_'): _nodes,
    ('', 'to'): _nodes,
    ('', 'caller_id'): _nodes,
    ('', 'package'): _packages,
    ('topic', 'name'): _topics,
    ('node', 'name'): _nodes,
    ('wait_for_node', 'name'): _nodes,
    ('live_node', 'name'): _nodes,
    ('is_node_alive', 'name'): _nodes,
    ('uri_of', 'name'): _nodes,
    ('lookup_service', 'name'): _services,
    ('wait_for_service', 'name'): _services,
    ('parameter', 'name'): _parameters,
    ('serve', 'typed_as'): _service_types,
    ('plot', 'fields'): _fields,
    ('message_class', 'type_or_class'): _message_types,
    ('service_class', 'type_or_class'): _service_types,
}


# -- in IPython


def equip(shell: Any) -> Callable[[], None]:
    """Have a session of IPython's complete so, in a terminal or a notebook; returns a function that
    ends it."""
    completer = shell.Completer
    all_completions = completer.completions
    has_ended = False
    typed = ''  # all that is typed, of which IPython tells its hooks the last line alone

    def note(text: str, offset: int) -> Any:
        nonlocal typed
        typed = text[:offset]
        found = all_completions(text, offset)
        place = None if has_ended else place_of(typed)
        if place is None or place.string is not None:
            return found
        keywords = completions(typed, shell.user_ns)
        if keywords and not place.word:
            return [each for each in found if each.text in keywords]
        return sorted(found, key=lambda each: each.text not in keywords) if keywords else found

    def complete(line: str, in_strings: bool) -> List[str]:
        code = typed if typed.endswith(line) else line
        place = place_of(code)
        if has_ended or place is None or (place.string is not None) is not in_strings:
            return []
        return completions(code, shell.user_ns)

    def complete_strings(_: Any, event: Any) -> List[str]:
        """Names instead of the files that IPython finds for a string."""
        return complete(event.text_until_cursor, True)

    def complete_keywords(_: str) -> List[str]:
        """Fields beside the variables that may stand there, too, once a letter is typed."""
        return complete(completer.text_until_cursor, False)

    evaluate_properties = _have_jedi_evaluate_no_properties()
    completer.completions = note
    completer.custom_matchers.append(complete_keywords)
    shell.set_hook('complete_command', complete_strings, re_key='(?s).*')

    def end() -> None:
        nonlocal has_ended
        has_ended = True  # IPython has no way to take the hook back
        evaluate_properties()
        del completer.completions
        completer.custom_matchers.remove(complete_keywords)

    return end


def _have_jedi_evaluate_no_properties() -> Callable[[], None]:
    """Have IPython complete what stands after a property without asking for its value, which may
    ask the whole graph, or wait for a message; returns a function that ends it.

    Without jedi IPython evaluates what is before the last dot, whatever it is told.
    """
    try:
        jedi: Any = importlib.import_module('jedi')
    except ImportError:
        return lambda: None
    # since 0.19 there is a setting
    owner, name = jedi.settings, 'allow_unsafe_interpreter_executions'
    if not hasattr(owner, name):
        owner, name = jedi.Interpreter, '_allow_descriptor_getattr_default'
    before = getattr(owner, name, False)
    setattr(owner, name, False)
    return functools.partial(setattr, owner, name, before)
