"""What mypy cannot know by itself: the fields that ``send_to`` takes as keywords, beside its own.

In the setup.cfg or mypy.ini of who uses this package::

    [mypy]
    plugins = pharos.mypy_plugin

Then a keyword is an error that is no field of the type where that is given by its name,
``typed_as='package/Type'``; and where it is not, one that differs from ``typed_as`` by a slip.
"""
import difflib
from typing import Any, Callable, List, Optional, Type

from mypy.nodes import StrExpr
from mypy.plugin import MethodContext, Plugin
from mypy.types import Instance
from mypy.types import Type as MypyType

from pharos import messages
from pharos.blocks import attempt


def plugin(version: str) -> Type[Plugin]:
    """What mypy asks for."""
    return PharosPlugin


class PharosPlugin(Plugin):
    """Checks the keywords by which ``send_to`` fills messages."""

    def get_method_hook(self, fullname: str) -> Optional[Callable[[MethodContext], MypyType]]:
        """Who looks at the calls of a method; None: nobody."""
        return _check_fields if fullname.endswith('.send_to') else None


def _check_fields(call: MethodContext) -> MypyType:
    """Tell of keywords that cannot be fields; returns what the call returns."""
    if isinstance(call.type, Instance) and call.type.type.has_base('pharos.node.Node'):
        given = dict(zip(call.callee_arg_names, zip(call.arg_names, call.args)))
        known = _fields_of(given['typed_as'][1])
        for name, value in zip(*given['fields']):
            if name is not None:  # of **fields
                complaint = _complaint(name, known)
                if complaint:
                    call.api.fail(f'Unexpected keyword argument "{name}"{complaint}', value)
    return call.default_return_type


def _complaint(name: str, known: Optional[List[str]]) -> str:
    """What is wrong with a keyword; empty where nothing is known to be.

    :param known: the names of the fields; None: they are not known
    """
    if known is None:
        # of the other keywords a field may have nearly the name
        slips = difflib.get_close_matches(name, ['typed_as'], 1, 0.8)
        return f'; did you mean "{slips[0]}"?' if slips else ''
    if name in known:
        return ''
    meant = difflib.get_close_matches(name, [*known, 'typed_as'], 1, 0.7)
    hint = f'; did you mean "{meant[0]}"?' if meant else f', but {", ".join(known)}'
    return f', which is no field{hint}'


def _fields_of(typed_as: List[Any]) -> Optional[List[str]]:
    """The names of the fields of a type whose name stands in the call; None: it is not known."""
    if len(typed_as) != 1 or not isinstance(typed_as[0], StrExpr):
        return None
    type_ = typed_as[0].value
    fields: Optional[List[str]] = attempt(lambda: list(messages.message_class(type_).__slots__))
    return fields
