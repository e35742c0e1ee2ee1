"""Parameters that a node watches, through the master's paramUpdate calls."""
import threading

from pharos.private_rospy.proxies import master_api


class WatchedParameters:
    """The parameters that one :class:`~.instance.PrivateRospy` watches."""

    def __init__(self, instance):
        self._instance = instance
        self._listeners = {}    # global name -> [function(value)]
        self._lock = threading.Lock()

    def hooks(self):
        """The load hooks: rospy tells only its own cache of a parameter that changed."""
        def tell_listeners(module):
            handler = module.ROSHandler
            update = handler.paramUpdate

            def paramUpdate(self_, caller_id, key, value):
                answer = update(self_, caller_id, key, value)
                return (1, '', 0) if self.tell(key, value) else answer
            handler.paramUpdate = paramUpdate
        return {'rospy.impl.masterslave': tell_listeners}

    def watch(self, name, listener):
        """Call ``listener(value)`` whenever the parameter is set; once more for the same listener is no more."""
        with self._lock:
            listeners = self._listeners.setdefault(name, [])
            if listener not in listeners:
                listeners.append(listener)
        self._subscribe(name)

    def _subscribe(self, name):
        instance = self._instance
        master_api(instance.settings.master_url, instance.name).subscribeParam(instance.uri, name)

    def put_back(self):
        """A restarted master has no parameters: set the node's private ones from its argv, and watch again."""
        client = self._instance.rospy.client
        for name, value in client.load_command_line_node_params(self._instance.settings.argv).items():
            self._instance.rospy.set_param('~' + name, value)
        with self._lock:
            watched = list(self._listeners)
        for name in watched:
            self._subscribe(name)

    def tell(self, key, value):
        """Tell the listeners of a parameter, also where the master names one that is nested in theirs, or around."""
        if not isinstance(key, str):
            return False
        key = '/' + key.strip('/')
        with self._lock:
            watched = {name: list(listeners) for name, listeners in self._listeners.items()
                       if name == key or key.startswith(name + '/')}
        for name, listeners in watched.items():
            if name != key:    # a part of it was set: they get the whole
                value = self._instance.rospy.get_param(name, None)
            for listener in listeners:
                listener(value)
        return bool(watched)
