"""Nodes for a session: one that ticks, one that tells of each text in three ways, and a service that
never answers."""
import threading
import time  # noqa: F401  # for the lines that are typed

from pharos import BlockNode, Master, Transcript, spin  # noqa: F401

master = Master()
if 'me' not in globals():  # where it is no workspace
    me = master.create(BlockNode, named='/me_at_the_prompt')


def tick(node):
    """Send for ever."""
    for _ in node.every(0.05):
        node.send_to('/begun', typed_as='std_msgs/String')


def tell(message, channel):
    """Show, log and print it."""
    Transcript.show('shown', message.data)
    channel.node.log(f'logged {message.data}')
    print('printed', message.data)


ticking = master.create(BlockNode, named='/ticking', soul=tick)
ticking.fork()
telling = master.create(BlockNode, named='/telling', delegate=tell)
telling.interested_in('/texts', 'std_msgs/String')
ticking.serve('/never_answers', 'std_srvs/Empty', lambda request: threading.Event().wait())
