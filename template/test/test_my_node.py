"""The node my_node."""
from my_package.my_node import MyNode
from pharos import BlockNode
from pharos.testing import Mailbox


def test_my_node_counts_messages(create_node):
    node, other = create_node(MyNode, argv=['_period:=0.1']), create_node(BlockNode)
    said = Mailbox(other, f'{node.name}/output', 'std_msgs/String')
    other.send_to(f'{node.name}/input', typed_as='std_msgs/String', data='hello')
    said.wait_for(lambda message: message.data == '1 came')
