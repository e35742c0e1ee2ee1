"""A property of a robot: after the last command, a stop, the lift stands.

    /usr/bin/python3 -m pytest -p pharos.testing test_lift.py

The lift has a mistake, so this fails: hypothesis tries scripts of commands, and shows the shortest one
that breaks the property. This needs no roscore.
"""
from hypothesis import HealthCheck, given, settings, strategies

from pharos import BlockNode, Node
from pharos.testing import Mailbox

EMPTY = 'std_msgs/Empty'


class Lift(Node):
    """Moves from /go to /stop."""

    def start(self):
        super().start()
        self.goes = False
        self.interested_in('/go', EMPTY, self.go)
        self.interested_in('/stop', EMPTY, self.halt)
        self.fork(Lift.move)

    def go(self, message):
        self.fork(Lift.open_brake)

    def open_brake(self):
        self.sleep(0.5)
        self.goes = True  # the mistake: a stop may have come meanwhile

    def halt(self, message):
        self.goes = False

    def move(self):
        for _ in self.every(0.1):
            self.send_to('/speed', typed_as='std_msgs/Float64', data=1.0 if self.goes else 0.0)


# each command has the tenths of a second until the next one
COMMANDS = strategies.tuples(strategies.sampled_from(['/go', '/stop']), strategies.integers(0, 9))
SCRIPTS = strategies.lists(COMMANDS, max_size=6).map(lambda script: [*script, ('/stop', 0)])


@settings(
    derandomize=True,  # the same scripts each time
    deadline=None,
    max_examples=50,
    # all scripts run in one simulation, each with a lift of its own
    suppress_health_check=[*HealthCheck],
)
@given(script=SCRIPTS)
def test_lift_stands_after_stop(simulation, script):
    master = simulation.master
    with master.create(Lift, 'lift'), master.create(BlockNode, 'operator') as operator:
        speeds = Mailbox(operator, '/speed', 'std_msgs/Float64')
        for command, tenths in script:
            operator.send_to(command, typed_as=EMPTY)
            simulation.run(tenths / 10)
        simulation.run(1)
        assert speeds.all()[-1].data == 0.0
