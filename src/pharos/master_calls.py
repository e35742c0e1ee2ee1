"""What a ROS master is asked for, each time anew: its state, whether nodes are there, the graph."""
import contextlib
import threading
import time
import urllib.parse
from typing import (
    TYPE_CHECKING,
    Any,
    Callable,
    Collection,
    Dict,
    Iterator,
    List,
    Optional,
    Tuple,
    TypeVar,
    Union,
)

import rosgraph

from pharos import on_demand
from pharos.errors import MasterUnreachableError, NodeStoppedError
from pharos.private_rospy.addresses import is_same_master
from pharos.private_rospy.lifetime import Interruption, is_after_stop, is_waiting
from pharos.private_rospy.deadlines import MARGIN, time_limit
from pharos.private_rospy.names import check_name
from pharos.private_rospy.proxies import ServerProxy, interruption, master_api
from pharos.private_rospy.registration import COMMUNICATION_ERRORS, PING_TIMEOUT, unreachable
from pharos.seconds import check_limit
from pharos.wrong_guesses import getattr_with_hint

if TYPE_CHECKING:
    from pharos.live.graph import Graph

TIMEOUT = 5.0  # seconds that a question to the master may take
POLL = 0.05  # seconds between two looks for a master, or for a node

Users = Dict[str, List[str]]  # name of a topic or service -> names of nodes
Self = TypeVar('Self', bound='MasterCalls')


class MasterCalls:
    """What can be asked of the ROS master at a URL; each call has a time limit.

    :attr:`url` is as :func:`check_url` has it.
    """

    url: str
    if not TYPE_CHECKING:
        __getattr__ = getattr_with_hint

    def api(self, caller_id: str = '/pharos', timeout: float = TIMEOUT) -> rosgraph.Master:
        """rosgraph's own API of the master; its calls take ``timeout`` seconds at the most."""
        return master_api(self.url, caller_id, timeout)

    def call(
        self, method: str, *args: Any, caller_id: str = '/pharos', timeout: float = TIMEOUT
    ) -> Any:
        """Call a method of :meth:`api`.

        A question about all that there is ends with the node on whose behalf this thread runs, as
        does whatever is part of a wait. Any other call about one name does not: a node that stops
        may still finish what it is about.

        :raises MasterUnreachableError: if the master does not answer
        :raises NodeStoppedError: if the node that asks stops meanwhile
        :raises rosgraph.MasterError: if the master refuses
        """
        api = self.api(caller_id, timeout)
        with self.reached():
            if args and not is_waiting():
                return getattr(api, method)(*args)
            with interruption(api.handle) as stop:
                try:
                    return getattr(api, method)(*args)
                except COMMUNICATION_ERRORS as error:
                    if stop.came:
                        raise NodeStoppedError(
                            f'the node that asked the master {self.url} stops'
                        ) from error
                    raise

    @contextlib.contextmanager
    def reached(self) -> Iterator[None]:
        """Within this, a failure to reach the master is a MasterUnreachableError that names it."""
        try:
            yield
        except COMMUNICATION_ERRORS as error:
            raise unreachable(self.url, error) from error

    def system_state(self) -> Tuple[Users, Users, Users]:
        """``(publishers, subscribers, services)``, each ``{name: [node names]}``."""
        publishers, subscribers, services = self.call('getSystemState')
        return dict(publishers), dict(subscribers), dict(services)

    def name_of(self, name: str, what: str, caller_id: Optional[str] = None) -> str:
        """The full name of a node, topic or service.

        One that the graph has is its name however it is written: rospy warns of '/my-node', and
        goes on.

        :param caller_id: the node to which '~name' is private
        :raises ValueError: if it cannot be one, and is none
        """
        try:
            check_name(name, what, private=caller_id is not None)
        except ValueError:
            if not self.has(name, what):
                raise
            return name
        resolved: str = rosgraph.names.resolve_name(name, caller_id or '/')
        return resolved

    def has(self, name: Any, what: str) -> bool:
        """Whether the graph has a 'node', 'topic' or 'service' of that full name; not, if the master
        does not answer."""
        if not isinstance(name, str) or not name.startswith('/'):
            return False
        try:
            publishers, subscribers, services = self.system_state()
        except MasterUnreachableError:
            return False
        if what == 'node':
            users = [*publishers.values(), *subscribers.values(), *services.values()]
            return any(name in nodes for nodes in users)
        return name in {'topic': {**publishers, **subscribers}, 'service': services}.get(what, ())

    def topic_types(self) -> List[Tuple[str, str]]:
        """``[(topic name, type name)]`` of all topics."""
        return list(self.call('getTopicTypes'))

    def is_node_alive(self, name: str, or_busy: bool = False) -> bool:
        """Whether the node of that name is registered and its XML-RPC server answers.

        :param or_busy: whether one counts, too, that does not answer in time but refuses nothing
        """
        try:
            return self._ask_node(name, 'getPid') is not None
        except COMMUNICATION_ERRORS as error:
            return or_busy and not isinstance(error, ConnectionRefusedError)

    def bus_info(self, name: str) -> Optional[List[Any]]:
        """The connections of the node of that name as ROS's getBusInfo has them, [] if it does not
        answer as a node does; None if it is not registered, or refuses the connection."""
        try:
            answer = self._ask_node(name, 'getBusInfo')
            return answer and list(answer[2])
        except ConnectionRefusedError:
            return None
        except (*COMMUNICATION_ERRORS, TypeError, LookupError):
            return []

    def _ask_node(self, name: str, method: str) -> Any:
        """What the XML-RPC server of a node answers, None where the master knows no such node.

        :raises COMMUNICATION_ERRORS: if it does not, in time
        """
        try:
            node = ServerProxy(self.call('lookupNode', name), PING_TIMEOUT)
        except (rosgraph.MasterException, MasterUnreachableError):
            return None
        with interruption(node):
            return getattr(node, method)('/pharos')

    def graph(
        self,
        seconds: float = 0,
        *,
        show_all: bool = False,
        services: bool = False,
        nodes_only: bool = False,
        namespace: Union[str, Collection[str]] = '/',
        hide: Union[str, Collection[str]] = (),
        group: str = 'process',
    ) -> 'Graph':
        """The :class:`~pharos.Graph` of all nodes and topics as they are: a picture in Jupyter, or
        in a file by its :meth:`save <pharos.Graph.save>`.

        Nodes that do not answer within a second are in it, too, and marked so.

        :param seconds: for which messages are counted, for the rates; 0: no rates are told. Nodes
            count them anyway, and none that nobody hears
        :param show_all: also what every node has: /rosout, /statistics, /clock,
            parameter_updates, and services for loggers
        :param services: services, too
        :param nodes_only: arrows from node to node, instead of topics
        :param namespace: only the nodes of that namespace, or of those
        :param hide: any of 'leaf' (topics that one node alone uses), 'unheard' (that nobody hears),
            'idle' (of which nothing is connected), 'tf', 'images', 'unreachable' (nodes that do not
            answer)
        :param group: what the frames are: 'process' (and hosts around them, where there are
            several), 'namespace' or 'none'
        :raises MasterUnreachableError: if the master does not answer
        :raises NodeStoppedError: if the node on whose behalf this thread counts stops meanwhile
        :raises TypeError, ValueError: if a choice is none of these
        """
        graph: 'Graph' = on_demand.module('live.graph').graph_of(
            self,
            seconds,
            show_all=show_all,
            services=services,
            nodes_only=nodes_only,
            namespace=namespace,
            hide=hide,
            group=group,
        )
        return graph

    @property
    def pid(self) -> int:
        """The process id of the master, on its host."""
        return int(self.call('getPid'))

    def is_reachable(self) -> bool:
        """Whether a master answers at the URL."""
        try:
            self.call('getPid')
        except MasterUnreachableError:
            return False
        return True

    def wait(self: Self, timeout: Optional[float] = None) -> Self:
        """Wait until the master answers, for up to ``timeout`` seconds (None: without limit);
        returns this Master.

        :raises MasterUnreachableError: if it does not in time
        :raises NodeStoppedError: if the node whose soul or delegate waits stops meanwhile
        """
        timeout = check_limit('timeout', timeout)
        with time_limit(timeout):
            is_there = self.look_until_found(
                lambda: self.is_reachable() or None, timeout, f'the master {self.url}'
            )
        if not is_there:
            self.call('getPid', timeout=MARGIN)
        return self

    def look_until_found(self, look: Callable[[], Any], timeout: Optional[float], what: str) -> Any:
        """Call ``look()`` until it returns something, for there is nobody who could tell; None
        where it has not in time.

        :param timeout: seconds, None: without limit
        :raises NodeStoppedError: if the node on whose behalf this thread waits stops meanwhile, or,
            without a limit, stops already
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        woken = threading.Event()
        with Interruption(woken.set) as stop:
            while not stop.came:
                try:
                    found = look()
                except NodeStoppedError:
                    break  # it stopped while the master was asked
                if found is not None or deadline is not None and time.monotonic() >= deadline:
                    return found
                if deadline is None and is_after_stop():
                    break
                woken.wait(POLL)
        raise NodeStoppedError(f'the node that waited for {what} stops')

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MasterCalls) and is_same_master(self.url, other.url)

    def __hash__(self) -> int:
        return hash(urllib.parse.urlsplit(self.url).port)  # the host may have several names
