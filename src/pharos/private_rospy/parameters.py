"""Parameters that a node watches, through the master's paramUpdate calls."""
import threading
import xmlrpc.client

from pharos.private_rospy.proxies import ServerProxy, master_api
from pharos.private_rospy.registration import COMMUNICATION_ERRORS, UNREGISTER_TIMEOUT


class WatchedParameters:
    """The parameters that one :class:`~.instance.PrivateRospy` watches, or has given a first value."""

    def __init__(self, instance):
        self._instance = instance
        self._listeners = {}      # global name -> [function(value)]
        self._initialized = {}    # global name -> its first value
        self._subscribed = set()  # global names of which the master tells, also those that rospy itself asked for
        self._lock = threading.Lock()

    def hooks(self):
        """The load hooks."""
        def tell_listeners(module):
            """rospy.impl.masterslave: only its own cache is told of a parameter that changed."""
            handler = module.ROSHandler
            update = handler.paramUpdate

            def paramUpdate(self_, caller_id, key, value):
                answer = update(self_, caller_id, key, value)
                return (1, '', 0) if isinstance(key, str) and self._tell(key, value) else answer
            handler.paramUpdate = paramUpdate

        def note_subscriptions(module):
            """rospy.impl.paramserver: what get_param_cached subscribed to, as a log line does, is never let go."""
            set_ = module.ParamServerCache.set

            def set(self_, key, value):
                self._subscribed.add(key)
                set_(self_, key, value)
            module.ParamServerCache.set = set
        return {'rospy.impl.masterslave': tell_listeners, 'rospy.impl.paramserver': note_subscriptions}

    def initialize(self, name, value):
        """Set the parameter where it has no value, also after a restart of the master."""
        self._initialized[name] = value
        self._set_where_missing(name, value)

    def take_over(self, former):
        """Go on where those of the node's former run ended."""
        for name, value in former._initialized.items():
            self.initialize(name, value)
        for name, listeners in former._listeners.items():
            for listener in listeners:
                self.watch(name, listener)

    def watch(self, name, listener):
        """Call ``listener(value)`` whenever the parameter is set; once more for the same listener is no more."""
        with self._lock:
            listeners = self._listeners.setdefault(name, [])
            if listener not in listeners:
                listeners.append(listener)
        self._subscribe(name)

    def _subscribe(self, name):
        self._subscribed.add(name)
        self._master().subscribeParam(self._instance.uri, name)

    def _set_where_missing(self, name, value):
        master = self._master()
        if not master.hasParam(name):
            master.setParam(name, value)

    def _master(self):
        return master_api(self._instance.settings.master_url, self._instance.name)

    def put_back(self):
        """A restarted master has no parameters: set the node's private ones and first values, and watch again."""
        client = self._instance.rospy.client
        for name, value in client.load_command_line_node_params(self._instance.settings.argv).items():
            self._instance.rospy.set_param('~' + name, value)
        for name, value in dict(self._initialized).items():
            self._set_where_missing(name, value)
        with self._lock:
            watched = list(self._listeners)
        for name in watched:
            self._subscribe(name)

    def tell_of_own(self, key, value):
        """The node itself has set a parameter: a master tells all but the one who sets, of what it holds, too."""
        self._tell(key, value)
        for name, listeners in self._listeners_where(lambda name: name.startswith(key + '/')):
            _call(listeners, self._value(name))

    def _tell(self, key, value):
        """Tell the listeners of a parameter, and of the namespaces around it; returns whether there are any."""
        key = '/' + key.strip('/')
        told = self._listeners_where(lambda name: name == key or key.startswith(name.rstrip('/') + '/'))
        for name, listeners in told:
            _call(listeners, value if name == key else self._value(name))    # a part of it was set: they get the whole
        return bool(told)

    def close(self):
        """Watch no longer: a master keeps the name of a node that does."""
        if not self._subscribed:
            return
        instance = self._instance
        calls = xmlrpc.client.MultiCall(ServerProxy(instance.settings.master_url, UNREGISTER_TIMEOUT))
        for name in list(self._subscribed):
            calls.unsubscribeParam(instance.name, instance.uri, name)
        try:
            calls()
        except COMMUNICATION_ERRORS as error:
            instance.rospy.logdebug('cannot tell the master %s that no parameter is watched any more: %s',
                                    instance.settings.master_url, error)

    def _listeners_where(self, condition):
        with self._lock:
            return [(name, list(listeners)) for name, listeners in self._listeners.items() if condition(name)]

    def _value(self, name):
        return self._instance.rospy.get_param(name, None)


def _call(listeners, value):
    for listener in listeners:
        listener(value)
