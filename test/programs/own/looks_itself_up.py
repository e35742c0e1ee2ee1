#!/usr/bin/python3
"""A program with classes that Python's library finds again by the name of their module."""
from __future__ import annotations

import copy
import dataclasses
import inspect
import io
import pickle
import sys
import typing

import rospy


@dataclasses.dataclass
class Pose:
    """Where something is."""

    x: float
    unit: typing.ClassVar[str] = 'm'
    at: Stamp = None


class Stamp:
    """When it was there."""


class Colour(typing.NamedTuple):
    """What it looks like."""

    red: int


def pickled(value):
    """The value as it comes out of a pickle."""
    file = io.BytesIO()
    pickle.dump(value, file, pickle.HIGHEST_PROTOCOL)
    file.seek(0)
    return pickle.load(file)


itself = sys.modules[__name__] is sys.modules['__main__'] and sys.modules[__name__].Pose is Pose
fields = [field.name for field in dataclasses.fields(Pose)]
pose = pickled(Pose(1.0))
colour = pickled(Colour(7))
source = inspect.getsource(Stamp)
module = inspect.getmodule(Stamp).__name__
hints = typing.get_type_hints(Pose)
time = pickled(rospy.Time(3, 4))
copied = [copy.copy(rospy.Time(3, 4)), copy.deepcopy(rospy.Duration(3, 4))]
