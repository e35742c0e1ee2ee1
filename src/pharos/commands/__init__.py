"""The commands of the package: ``pharos NAME`` and ``rosrun pharos NAME`` run the ``main`` of the
module of that name."""
