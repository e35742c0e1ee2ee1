"""A user's program with mistakes that mypy finds: see test_typing.py."""
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
