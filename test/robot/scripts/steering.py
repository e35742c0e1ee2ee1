"""How fast to go and how far to turn; the helper module of the avoider."""
from geometry_msgs.msg import Twist

calls = 0


def avoid(distance, speed):
    """Return the command for this distance to the obstacle."""
    global calls
    calls += 1
    command = Twist()
    if distance < 0.5:
        command.angular.z = 1.0
    else:
        command.linear.x = speed
    return command
