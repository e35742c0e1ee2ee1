"""Calls a service of the turtle simulator whose type is not known here."""
import importlib.util

import pharos
from pharos.messages import turtlesim

assert importlib.util.find_spec('turtlesim') is None
text = turtlesim.DEFINITIONS['srv'].pop('turtlesim/TeleportAbsolute')
service = pharos.Master().lookup_service('/turtle1/teleport_absolute')
print(service.type, service.md5sum)
try:
    service.call(x=1.0)
except pharos.UnknownTypeError as error:
    print(error)
pharos.define_service(service.type, text)
service.call(x=1.0, timeout=20)
service.md5sum = 'wrong'
try:
    service.call()
except pharos.ServiceTypeError as error:
    print(error)
