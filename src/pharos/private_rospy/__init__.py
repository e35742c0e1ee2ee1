"""A rospy of its own for each node: the only place that touches rospy's inside.

rospy keeps its node in module globals. This room loads rospy's code once per node instead, with
globals of its own, and mends what it does badly. The way in is
:class:`~.instance.PrivateRospy`: the rospy of one run of a node.

- patches: what is mended in rospy, one function each, as a table; loader and process_rospy: how
  its modules are loaded for a node, and for the process.
- settings, arguments, addresses, names, logs: what a node is to be called, where it is, its log.
- registration, connections, refusals, parameters, changes: what a node has at the master, whom it
  is connected to, whom it cannot hear, and waiting for that.
- lifetime, deadlines, proxies: threads, sockets and calls that end with the node, or in time.
- acceptor, xmlrpc_server: clients that say nothing, or nonsense.
- local_link, plain_receivers, local_services: how rospy's topics and services take the way through
  this process; sender, tcpros_connection: through sockets.
"""
