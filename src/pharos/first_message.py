"""What keeps the first message on a topic from being lost."""
import time
from typing import TYPE_CHECKING, Set

from pharos.errors import MasterUnreachableError
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.lifetime import Interruption
from pharos.private_rospy.registration import REGISTER_TIMEOUT
from pharos.private_rospy.shared_connections import SHARED

if TYPE_CHECKING:
    from pharos.output_channel import OutputChannel

# seconds in which the master has told a live subscriber; then, and every so many, it is asked whether
# it lives
ANSWER_TIMEOUT = 0.5


def wait_for_known_subscribers(channel: 'OutputChannel', timeout: float, deadline: float) -> None:
    """Wait until the subscribers that the master knows are connected to a channel that has just
    been opened.

    rospy loses what is published before (ros_comm #176, #286).

    :param timeout: seconds that it may take
    :param deadline: when these are over, by ``time.monotonic()``
    """
    node, rospy = channel.node, channel.node.latest_run.rospy
    missing = rospy.connections.known_subscribers(channel.topic)
    if missing is None:  # not always: a large graph's state takes long to read
        try:
            with time_limit(max(REGISTER_TIMEOUT, deadline - time.monotonic())):
                missing = set(node.master.topic(channel.topic).subscribers)
        except MasterUnreachableError:  # the topic is registered already
            return

    def connected() -> bool:
        missing.difference_update(name for name, _ in channel.connections)
        missing.difference_update(
            other.name for other in node.master.local_nodes() if other.latest_run.is_ending
        )
        missing.difference_update(rospy.refusals.subscribers(channel.topic))
        return not missing or not channel.is_open or not node.is_running

    with Interruption(lifetime=rospy.lifetime) as stop:
        while True:
            left = deadline - time.monotonic()
            rospy.wait_until(connected, min(left, ANSWER_TIMEOUT))
            if connected() or stop.came:
                return
            if left <= ANSWER_TIMEOUT:
                break
            with time_limit(deadline - time.monotonic()):
                missing.intersection_update(
                    name for name in tuple(missing) if _may_connect(channel, name)
                )
    if timeout:
        _tell_who_is_late(channel, missing, timeout)


def _may_connect(channel: 'OutputChannel', name: str) -> bool:
    """False if the subscriber refuses connections, or hears the channel through another node of its
    process. One that does not answer may connect yet."""
    node = channel.node
    connections = node.master.bus_info(name)
    return connections is not None and not any(
        str(node.uri) in told and channel.topic in told and SHARED in told
        for told in (str(connection) for connection in connections)
    )


def _tell_who_is_late(channel: 'OutputChannel', names: Set[str], timeout: float) -> None:
    """Say in the log, once for each topic, which subscribers may miss the first message."""
    node, told = channel.node, channel.node.latest_run.rospy.connections.told_late
    if channel.topic not in told:
        told.add(channel.topic)
        node.log(
            f'{channel.topic}: {", ".join(sorted(names))} did not connect within {timeout:g} s,'
            f' though the master has them as subscribers, and may miss the first messages of'
            f' {node.name}: can they reach this host, and are they of the same type? A longer'
            ' connect_timeout waits longer',
            level='warning',
        )
