#!/usr/bin/python3
"""Four nodes that share the arguments of the program, and tell what each has of them."""
import sys

from pharos import BlockNode, Master, spin

master = Master()
for name in '/talker', '/listener', 'left/eye', 'right/eye':
    node = master.create(BlockNode, named=name, argv=sys.argv)
    topic = node.output_channel('image', 'std_msgs/String', latch=True).topic
    private = [node.parameter('~' + name).value for name in ('given', 'mine', 'threshold')]
    print('SEEN', node.name, topic, *private, node.ros.get_namespace(), flush=True)
print('SEEN all', flush=True)
spin()
