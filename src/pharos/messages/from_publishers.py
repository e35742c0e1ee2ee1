"""Message types as the publishers of a topic define them, for a subscriber without a package of
them.

A publisher describes its messages in its connection header: by 'type', 'md5sum' and
'message_definition'. Whoever calls these functions has asked for the headers.
"""
from typing import Dict, Iterable, Optional, Tuple, Type

import genpy

from pharos.errors import PharosError
from pharos.messages.classes import class_from_definition
from pharos.messages.fields import describe_fields

Header = Dict[str, str]


def class_from_publishers(
    topic: str, type_: str, headers: Iterable[Tuple[str, Header]]
) -> Optional[Type[genpy.Message]]:
    """The class of a topic's messages by the first definition that can be read.

    :param headers: (node name, connection header) of each publisher; asked for one by one
    :returns: None if no publisher defines that type
    :raises UnknownTypeError, MessageTypeError: if those who define it give nonsense, or not what
        has the md5sum they give
    """
    refused = None
    for publisher, header in headers:
        if not (header.get('message_definition') and header.get('type') == type_):
            continue
        try:
            return class_of_header(header)
        except PharosError as error:
            refused = type(error)(
                f'{publisher} publishes on {topic} what cannot be read here: {error}'
            )
            refused.__cause__ = error
    if refused:
        raise refused
    return None


def class_of_header(header: Header) -> Type[genpy.Message]:
    """The class that a publisher's connection header defines.

    :raises UnknownTypeError, MessageTypeError: as :func:`class_from_definition`
    """
    return class_from_definition(
        header.get('type'), header.get('message_definition'), header.get('md5sum')
    )


def explain_refusal(
    subscriber: str, topic: str, wanted: Type[genpy.Message], publisher: str, offered: Header
) -> str:
    """Why the node ``subscriber``, which wants messages of a class, cannot hear a publisher.

    :param offered: the publisher's connection header
    """
    type_, md5sum = offered.get('type', ''), offered.get('md5sum')
    if md5sum == '*':
        theirs = 'messages of any type'
        advice = 'only subscribers of any type (rospy.AnyMsg) can be'
    else:
        try:
            fields = describe_fields(class_of_header(offered))
        except PharosError:
            fields = 'its fields are not known here'
        theirs = f'{type_} [{md5sum}] ({fields})'
        advice = 'use one type, or another topic'
        if type_ == wanted._type:
            advice = f"have both sides use the same {type_.rpartition('/')[2]}.msg"
    return (
        f'{subscriber} wants {topic} as {wanted._type} [{wanted._md5sum}]'
        f' ({describe_fields(wanted)}), but {publisher} publishes {theirs},'
        f' and is not heard: {advice}'
    )
