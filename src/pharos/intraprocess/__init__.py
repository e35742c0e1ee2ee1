"""INTRAPROCESS: how messages and service calls get from one node of this process to another.

It knows messages as genpy has them, and nothing of rospy, nodes or channels: private_rospy hands it
what it needs of these. A message goes this way:

- fanout: from a publisher to all who are interested, with what is latched
- copier, conversions: a snapshot of it, and a copy of that for each receiver
- sharing: the message itself, for receivers that share it
- link: which receivers of another node hear the publisher
- inbox: what waits for a receiver, and the interface of those: Receiver
- dispatcher: runs the delegates of a node, one at a time

- services: a call of a service
"""
