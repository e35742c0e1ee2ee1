"""A small package of a user's."""
import pharos


class Echo(pharos.Node):
    """Says again what it hears."""

    def __init__(self, times: int = 1) -> None:
        super().__init__()
        self.times = times

    def start(self) -> None:
        super().start()
        self.interested_in('/heard', 'std_msgs/String', delegate=self.repeat)

    def repeat(self, message, channel) -> None:
        if not message.data:
            raise ValueError('nothing was said')
        self.send_to('/said', typed_as='std_msgs/String', data=message.data * self.times)
