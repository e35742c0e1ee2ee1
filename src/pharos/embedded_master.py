"""A ROS master of one's own, as a child process: see :meth:`Master.embedded`."""
import os
import subprocess
import sys
from typing import Tuple

from pharos.errors import MasterUnreachableError, PortInUseError
from pharos.private_rospy.addresses import check_environment, loopback


def start(port: int) -> Tuple['subprocess.Popen[str]', str]:
    """Start the child; returns ``(process, URL)``.

    :raises PortInUseError: if the port is taken
    :raises ValueError: if ROS_HOSTNAME or ROS_IP cannot be an address of this host
    """
    environ = dict(os.environ, PYTHONPATH=os.pathsep.join(path for path in sys.path if path))
    if check_environment(environ) is None:
        environ['ROS_HOSTNAME'] = loopback()  # for this host alone, where nothing else is said
    # Ctrl-C is the program's
    child = subprocess.Popen(
        [sys.executable, '-m', 'pharos.master_program', str(port), str(os.getpid())],
        env=environ,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert child.stdout
    line = child.stdout.readline().strip()
    if line.startswith('http://'):
        return child, line
    end(child)
    if line.startswith('busy'):
        raise PortInUseError(
            f"port {port} for a master cannot be bound ({line.partition(' ')[2]}): choose another"
            " port, or 0 for any free one"
        )
    raise MasterUnreachableError(
        'a master of our own did not start: is python3-rosmaster installed?'
    )


def end(child: 'subprocess.Popen[str]') -> None:
    """End the child, and wait for it."""
    assert child.stdin
    with child:  # closes its pipes
        child.stdin.close()
        try:
            child.wait(10)
        except subprocess.TimeoutExpired:
            child.kill()
