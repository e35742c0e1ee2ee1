"""What is mended in rospy: one function for each override, in a table that the loader applies.

To add one, write a function at module level in the file here that is about its matter:

    @patch('rospy.impl.registration', 'RegManager.cleanup', 'trips over a time-out (ros_comm #1)')
    def cleanup(self, reason, *, node, original):
        ...

Its parameters before the ``*`` are those of rospy's function, by the same names. Those after it, of
which a patch names what it needs, are its node's own: ``node``, the
:class:`~pharos.private_rospy.instance.PrivateRospy`; ``original``, what it replaces; ``module``,
the private module that holds the target. They are filled in once per node, so that a patch costs no
further frame. ``@addition`` gives a class or module of rospy a function that it has not,
``@substitute`` a module another object for one of its names. What a patch remembers belongs to the
node, never to a module.

A target that is missing, or that has other parameters, is an error when a node is made, or imports
the library that has it.

test/test_patches.py compares the sources of the targets with the releases of rospy that are known
(and says how to know another), and doc/patches.md is this table: ``tools/patches`` writes it.
"""
import importlib
import pkgutil

from pharos.private_rospy.patches.table import TABLE, apply, check_applied

__all__ = ['TABLE', 'apply', 'check_applied']

for _each in pkgutil.iter_modules(__path__):
    importlib.import_module(f'{__name__}.{_each.name}')
