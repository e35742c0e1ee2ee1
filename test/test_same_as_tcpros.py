"""What a delegate gets through INTRAPROCESS is what it gets through TCPROS; what one refuses, the
other does too."""
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers import speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT
import pharos
from pharos import BlockNode
from test_copier import CLASSES, messages, told

pytestmark = pytest.mark.filterwarnings('ignore')  # numpy warns of some of the wrong values


def send(channel, message, mailbox):
    """What arrives, or the error that it raises at the publisher instead."""
    try:
        channel.publish(message)
    except pharos.MessageTypeError as error:
        return type(error)
    return mailbox.next()


@pytest.mark.parametrize('message_class', CLASSES, ids=lambda cls: cls._type)
def test_a_message_arrives_alike(master, message_class):
    receiver, remote, sender = (
        master.create(BlockNode, named=name, domain='127.0.0.1')
        for name in ('/receiver', '/remote', '/sender')
    )
    in_process, through_tcpros = Mailbox(), Mailbox()
    receiver.interested_in('/in_process', message_class, delegate=in_process)
    speak_tcpros_only(remote).interested_in(
        '/through_tcpros', message_class, delegate=through_tcpros
    )
    channels = [
        sender.output_channel(topic, message_class) for topic in ('/in_process', '/through_tcpros')
    ]
    for channel, link in zip(channels, [('/receiver', 'INTRAPROCESS'), ('/remote', 'TCPROS')]):
        assert channel.wait_for_subscribers(1, TIMEOUT)
        assert channel.connections == [link]

    @settings(
        max_examples=10, deadline=None, suppress_health_check=list(HealthCheck), database=None
    )
    @given(st.booleans().flatmap(lambda wrong: messages(message_class, wrong)))
    def arrives_alike(message):
        ours, theirs = send(channels[0], message, in_process), send(
            channels[1], message, through_tcpros
        )
        if isinstance(ours, type) or isinstance(theirs, type):
            assert ours is theirs
        else:
            del ours._connection_header, theirs._connection_header  # which name different topics
            assert told(ours) == told(theirs)

    arrives_alike()
