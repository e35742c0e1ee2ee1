"""Definitions of turtlesim's types, for machines without that package: Debian 12 has none.

The messages are those of ROS Fuerte, which the PhaROS report uses: velocities are sent as
turtlesim/Velocity; later releases send geometry_msgs/Twist, and the rest is unchanged.
"""

_COLOUR = 'uint8 r\nuint8 g\nuint8 b\n'
_PLACE = 'float32 x\nfloat32 y\nfloat32 theta\n'
_VELOCITY = 'float32 linear\nfloat32 angular\n'

#: ``{'msg' or 'srv': {type: text}}``
DEFINITIONS = {
    'msg': {
        'turtlesim/Color': _COLOUR,
        'turtlesim/Pose': _PLACE + '\nfloat32 linear_velocity\nfloat32 angular_velocity\n',
        'turtlesim/Velocity': _VELOCITY,
    },
    'srv': {
        'turtlesim/Kill': 'string name\n---\n',
        'turtlesim/SetPen': _COLOUR + 'uint8 width\nuint8 off\n---\n',
        'turtlesim/Spawn': (
            _PLACE + 'string name  # may be empty: turtlesim finds one\n---\nstring name\n'
        ),
        'turtlesim/TeleportAbsolute': _PLACE + '---\n',
        'turtlesim/TeleportRelative': _VELOCITY + '---\n',
    },
}
