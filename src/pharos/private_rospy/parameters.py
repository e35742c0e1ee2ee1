"""Parameters that a node watches, or keeps the values of, through the master's paramUpdate calls."""
import contextlib
import copy
import os
import reprlib
import socket
import threading
import weakref
import xmlrpc.client
from typing import Any

import rosgraph

from pharos.private_rospy import registration
from pharos.private_rospy.deadlines import deadline_in, seconds_left, time_limit
from pharos.private_rospy.proxies import master_api

TIMEOUT = 5.0  # seconds that all may take for which a parameter is read, watched or initialized
UNKNOWN: Any = object()  # the value of a parameter that is not kept

_of_all_nodes: Any = weakref.WeakSet()  # the WatchedParameters of this process
_adding = threading.Lock()  # guards it


class WatchedParameters:
    """The parameters that one :class:`~.instance.PrivateRospy` watches, has given a first value, or
    has read.

    A value that was read is kept until the master, or somebody in this process, says that it has
    changed; then it is asked for anew. What the master says is not taken for the value: it may be
    older than what the node itself has set meanwhile, of which the master does not tell it.
    """

    def __init__(self, node):
        self._node = node
        self._watched = []  # (global name, function(value))
        self._initialized = {}  # global name -> its first value
        # of those watched, the outermost: of what is in them, the master tells for each
        self._subscribed = set()
        # names of which the master was ever asked to tell, also where its answer did not come
        self._asked = set()
        self.cached = set()  # global names of which rospy itself has the master tell
        self._lock = threading.Lock()  # held to add to _watched
        self._subscribing = threading.Lock()  # guards _subscribed and _asked
        self._kept = {}  # global name -> value, None where it has none
        self._changes = 0  # how often something changed
        self._keeping = threading.Lock()  # held to change these two
        with _adding:
            _of_all_nodes.add(self)

    def may_subscribe(self):
        """Whether the master may still be asked to tell the node of a parameter."""
        return not (self._node.ended.is_set() or self._node.has_lost_name)

    def initialize(self, name, value):
        """Set the parameter where it has no value, also after a restart of the master."""
        with time_limit(TIMEOUT):
            self._set_where_missing(name, value)
        self._initialized[name] = value

    def restore_from_previous_run(self, former):
        """Know what those of the node's former run knew; :meth:`renew` tells the master."""
        self._initialized, self._watched = dict(former._initialized), list(former._watched)

    def renew(self):
        """Have the master know the first values, and what is watched."""
        for name, value in dict(self._initialized).items():
            self._set_where_missing(name, value)
        # namespaces before what is in them
        for name in sorted({name for name, _ in self._watched}):
            self._subscribe(name)

    def watch(self, name, listener):
        """Call ``listener(value)`` whenever the parameter is set; once more for the same listener
        is no more."""
        entry = name, listener
        with self._lock:
            is_new = entry not in self._watched
            if is_new:
                self._watched.append(entry)
        try:
            self._subscribe(name)
        except BaseException:
            if is_new:
                self._watched.remove(entry)
            raise

    def kept(self, name):
        """The value of a parameter that was read before, None where it has none; UNKNOWN if it was
        not, or has changed since."""
        return _own(self._kept.get(name, UNKNOWN))

    def read(self, name, ask):
        """The value of a parameter, which is kept from now on.

        :param ask: ``ask()`` asks the master for it
        """
        before = self._changes
        with time_limit(TIMEOUT):
            is_told = self._subscribe(name)
            value = ask()
        with self._keeping:
            if is_told and before == self._changes:  # else what came may be older
                self._kept[name] = value
        return _own(value)

    def forget(self, key):
        """A parameter has changed: its value, those in it and those around it are asked for anew."""
        with self._keeping:
            self._changes += 1
            for name in list(self._kept):
                if _contains(name, key) or _contains(key, name):
                    del self._kept[name]

    @property
    def listeners(self):
        """Those that :meth:`watch` was given."""
        return [listener for _, listener in self._watched]

    def _subscribe(self, name):
        """Have the master tell of the parameter; returns whether it does."""
        with time_limit(TIMEOUT), self._turn():
            if not self.may_subscribe():
                return False
            if any(_contains(other, name) for other in self._subscribed):
                return True
            if not registration.keeps_name(self._node):
                return False
            master, uri = self._master(), self._node.uri
            self._asked.add(name)
            master.subscribeParam(uri, name)
            within = {other for other in self._subscribed if _contains(name, other)}
            self._subscribed = self._subscribed - within | {name}
            for other in within - self.cached:
                master.unsubscribeParam(uri, other)
            return True

    def subscribe_for_rospy(self, name, subscribe):
        """What ``subscribe()`` returns, by which rospy itself has the master tell of a parameter."""
        with self._turn():
            if not self.may_subscribe():
                raise KeyError(name)
            self._asked.add(name)
            return subscribe()

    @contextlib.contextmanager
    def _turn(self):
        """Within this, no other thread of the node subscribes, nor does its stop unsubscribe.

        :raises socket.timeout: if another one takes too long, for the master does not answer
        """
        if not self._subscribing.acquire(timeout=seconds_left(deadline_in(TIMEOUT))):
            raise socket.timeout('timed out')
        try:
            yield
        finally:
            self._subscribing.release()

    def _set_where_missing(self, name, value):
        master = self._master()
        if not master.hasParam(name):
            with changing(name):
                master.setParam(name, value)

    def _master(self):
        return master_api(self._node.settings.master_url, self._node.name)

    def restore_after_master_restart(self):
        """A restarted master has no parameters: set the node's private ones and first values, and
        watch again."""
        rospy = self._node.module
        private = rospy.client.load_command_line_node_params(self._node.settings.argv)
        for name, value in private.items():
            rospy.set_param('~' + name, value)
        cache = rospy.impl.paramserver.get_param_server_cache()
        for name in list(self.cached):
            with contextlib.suppress(KeyError):
                cache.delete(name)  # rospy subscribes anew when it is asked for it
            self.cached.discard(name)
        with self._subscribing:
            self._subscribed.clear()
        self.forget('/')
        self.renew()

    def tell_of_own(self, key, value):
        """The node itself has set a parameter, of which a master tells all but the one who sets."""
        # those subscribed to a part of a dict are told, whoever sets it
        is_told_by_master = isinstance(value, dict) and not any(
            _contains(name, key) for name in tuple(self._subscribed)
        )
        self.tell(key, value, within=not is_told_by_master)

    def tell(self, key, value, within=True):
        """Tell the listeners of a parameter, and of what is around and ``within`` it; returns
        whether the master is to go on telling of it."""
        key = '/' + key.strip('/')
        self.forget(key)
        told = [
            (name, listener)
            for name, listener in tuple(self._watched)
            if _contains(name, key) or within and _contains(key, name)
        ]
        for name, listener in told:
            listener(value if name == key else self._value(name))
        return bool(told) or any(_contains(name, key) for name in tuple(self._subscribed))

    def unsubscribe(self, calls):
        """Add to the calls those that end the watch: a master keeps the name of a node that does
        not.

        What another thread was just subscribing to is, and nothing more will be.
        """
        with time_limit(registration.UNREGISTER_TIMEOUT), contextlib.suppress(socket.timeout):
            with self._turn():
                pass
        for name in tuple(self._asked):
            calls.unsubscribeParam(self._node.name, self._node.uri, name)

    def _value(self, name):
        try:
            return self._master().getParam(name)  # rospy would remap the name once more
        except rosgraph.MasterError:
            return None


@contextlib.contextmanager
def changing(key):
    """Within this, somebody in this process sets or deletes a parameter: no node of it has the old
    value afterwards, whenever the master comes to tell it, and whether or not an error came back.
    """
    try:
        yield
    finally:
        with _adding:
            nodes = list(_of_all_nodes)
        for parameters in nodes:
            parameters.forget(key)


class _Marshaller(xmlrpc.client.Marshaller):
    """Refuses what xmlrpc would store as a dict of its attributes: a function as an empty one."""

    dispatch: Any = dict(xmlrpc.client.Marshaller.dispatch)

    def dump_instance(self, value, write):
        if type(value) not in xmlrpc.client.WRAPPERS:
            raise TypeError(f'cannot marshal {type(value)} objects')
        super().dump_instance(value, write)

    dispatch['_arbitrary_instance'] = dump_instance


def as_stored(name, value):
    """The value as the parameter server brings it back: with lists for tuples.

    :raises ValueError: if it can hold no such value
    """
    try:
        return xmlrpc.client.loads(_Marshaller('utf-8').dumps((value,)))[0][0]
    except Exception as error:  # of several kinds; text with characters that XML has not, for one
        hint = ', but what its tolist() returns' if "'numpy." in str(error) else ''
        raise ValueError(
            f'{name} cannot be {reprlib.repr(value)}: the parameter server holds booleans, numbers '
            f'(integers of 32 bits), strings, and lists and dicts of them ({error}{hint})'
        ) from error


def _own(value):
    """The value, for somebody who may change it."""
    return copy.deepcopy(value) if isinstance(value, (dict, list)) else value


def _contains(namespace, name):
    """Whether ``name`` is the namespace or in it."""
    return (name + '/').startswith(namespace.rstrip('/') + '/')


def _forget():
    """In a process that was forked, when another thread may have held the lock."""
    global _adding
    _adding = threading.Lock()


os.register_at_fork(after_in_child=_forget)
