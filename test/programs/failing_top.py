"""rosrun pharos top with a fault of its own, at its third look: failing_top.py SCRIPT."""
import runpy
import sys

from pharos.live import top

looks, measure = [], top.Meter.measure


def fail(meter):
    """Measure twice."""
    looks.append(1)
    if len(looks) > 2:
        raise RuntimeError('a fault of its own')
    return measure(meter)


top.Meter.measure = fail
sys.argv = [sys.argv[1], '--interval', '0.1']
runpy.run_path(sys.argv[0], run_name='__main__')
