"""A node's XML-RPC server: its requests have limits, its log says who was refused, and it ends."""
from pharos.private_rospy.acceptor import BACKLOG, Acceptor, brief
from pharos.private_rospy.lifetime import shutdown_socket
from pharos.private_rospy.patches.table import addition, patch, substitute
from pharos.private_rospy.xmlrpc_server import RequestHandler, caller


@substitute(
    'rosgraph.xmlrpc',
    'SilenceableXMLRPCRequestHandler',
    'serves requests that are silent or huge for ever',
)
def request_handler():
    """The class that serves one client."""
    return RequestHandler


@patch(
    'rosgraph.xmlrpc',
    'XmlRpcNode.start',
    'binds its port in another thread, where an error is printed and cannot be raised',
)
def start(self, *, node):
    """Bind the port here, and serve each client in a thread of the node's."""
    node.lifetime.xmlrpc = self
    self._run_init()
    server = self.server
    server.socket.listen(BACKLOG)
    server.node, server.acceptor = node, Acceptor('XML-RPC', node)
    self.accepting = node.start_thread(
        server.acceptor.accept, (server.socket, server.process_request_thread), 'xmlrpc-accept'
    )


@patch(
    'rosgraph.xmlrpc',
    'XmlRpcNode.shutdown',
    'only closes the socket, on which its thread then spins (ros_comm #2238)',
)
def shutdown(self, reason, *, node):
    """Unregister, and end the thread that accepts clients."""
    self.is_shutdown = True
    server, handler = self.server, self.handler
    self.server = self.handler = None  # first, for others take that for stopped
    if handler:
        handler._shutdown(reason)
    if server:
        shutdown_socket(server.socket)
        self.accepting.join()  # closed any earlier, the socket could not wake it any more
        server.server_close()
    node.lifetime.silent.set()


@addition(
    'rosgraph.xmlrpc',
    'XmlRpcHandler._dispatch',
    'does not say whose the calls were that it refused',
)
def dispatch(self, method, params):
    """Called by the standard library's server; logs what is no call, and whose it is.

    A call that ROS's slave API answers with an error is the caller's affair: peers come too late,
    or try.
    """
    try:
        if method.startswith('_') or not hasattr(self, method):
            raise AttributeError(f'method "{method}" is not supported')
        return getattr(self, method)(*params)
    except Exception as error:
        caller().log_rejection(f'call of {brief(method)}: {error}')
        raise
