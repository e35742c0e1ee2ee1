"""A user's program with mistakes that mypy finds, some of them with pharos.mypy_plugin: see
test_typing.py."""
import pharos


class Driver(pharos.Node):
    """A node with a keyword of its own."""

    def __init__(self, speed: float = 1.0) -> None:
        super().__init__()
        self.speed = speed

    def go(self) -> int:
        return 3


master = pharos.Master()
driver = master.create(Driver, named='/driver', speed=2.0, soul=lambda me: me.go())
driver.go().bit_length()
driver.fly()  # mistake: a Driver does not
master.create(Driver, named='/driver', sped=2.0)  # mistake: no keyword of Driver's or create's
master.create(pharos.BlockNode, named='/driver', tcp_port='11312')  # mistake: no number
master.create(pharos.Node, named='/driver', callback=print)  # mistake: nobody takes that
master.create(Driver, name='/driver')  # mistake: named=
pharos.BlockNode('/driver')  # mistake: a node is made by a master
driver.name = '/other'  # mistake: it is given to create()
driver.interested_in('/speed', typed_a='std_msgs/Float32')  # mistake: typed_as=
driver.wait_for_message('/speed', where=1.0)  # mistake: no block
driver.parameter('~speed', initialised=1.0)  # mistake: initialized=
driver.Publisher('/speed')  # mistake: rospy's
driver.send_to('/speed', typed_a='std_msgs/Float32', data=1.0)  # with the plugin: typed_as=
driver.send_to('/speed', typed_as='std_msgs/Float32', date=1.0)  # with the plugin: data=
with master.create(Driver, named='/driver') as other:
    other.send_to('/speed', typed_as='std_msgs/Float32', latch=True)  # with the plugin: no field
