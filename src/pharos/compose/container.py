"""A node that loads programs into a composition, and unloads them, by nodelet's services."""
from __future__ import annotations

import contextlib
from typing import Any

import rosgraph.names

from pharos.compose.child_process import find_program
from pharos.compose.composition import Composition
from pharos.compose.script import ScriptNode
from pharos.compose.sources import source_of, why_apart
from pharos.errors import PharosError, UnknownNodeError, UnknownTypeError
from pharos.node import Node


LOAD_LIMIT = 2.0  # seconds in which a program that fails is an error of the call


class Container(Node):
    """Loads programs as nodelet's manager loads nodelets.

    Use: ``rosrun nodelet nodelet load PACKAGE/EXECUTABLE CONTAINER __name:=NAME``.

    :param composition: the programs become nodes of this composition
    """

    def __init__(self, composition: Composition):
        self.composition = composition
        self._loaded_nodes: dict[str, ScriptNode] = {}
        self._bonds: dict[str, Any] = {}

    def start(self):
        """Offer the services, if nodelet is installed."""
        super().start()
        with contextlib.suppress(UnknownTypeError):
            self.serve('~load_nodelet', 'nodelet/NodeletLoad', self._load)
            self.serve('~unload_nodelet', 'nodelet/NodeletUnload', self._unload)
            self.serve('~list', 'nodelet/NodeletList', lambda request: list(self._running_nodes()))

    def _running_nodes(self):
        nodes = self._loaded_nodes.items()
        return {name: node for name, node in nodes if node.is_running}

    def _load(self, request):
        package, _, executable = request.type.partition('/')
        path = find_program(package, executable)
        reason = why_apart(path)
        if reason:
            raise PharosError(f'{path} cannot run here, since {reason}: run it as a process')
        requested_name = self._full_name(request.name)
        name = requested_name
        if name in self._running_nodes():
            raise PharosError(f'{name} is loaded already: unload it first, or name another')
        # the program `nodelet load` is itself a node of that name
        if request._connection_header.get('callerid') == name:
            name += f'_in_{self.name.rpartition("/")[2]}'
            self.master.parameters[name] = self.master.parameters.get(requested_name, {})
        remappings = zip(request.remap_source_args, request.remap_target_args)
        arguments = [*request.my_argv, *(f'{source}:={target}' for source, target in remappings)]
        arguments.append(f'__name:={name.rpartition("/")[2]}')
        node = self.composition.start(name, source_of(path), arguments, init_timeout=LOAD_LIMIT)
        self._loaded_nodes[requested_name] = node
        if request.bond_id:
            self._start_bond(requested_name, request.bond_id)
        return True

    def _start_bond(self, name, bond_id):
        """Unload a program as soon as the process that has loaded the program is gone."""
        bond_class = self.ros_import('bondpy.bondpy').Bond
        bond = bond_class(f'{self.name}/bond', bond_id, on_broken=lambda: self._drop(name))
        self._bonds[name] = bond
        bond.start()

    def _full_name(self, name):
        return rosgraph.names.resolve_name(name, self.name)

    def _unload(self, request):
        name = self._full_name(request.name)
        if name not in self._running_nodes():
            raise UnknownNodeError(f'{request.name!r} is not loaded here: ~list names all that are')
        self._drop(name)
        return True

    def _drop(self, name):
        node = self._loaded_nodes.pop(name, None)
        bond = self._bonds.pop(name, None)
        if node:
            node._stop_safely()
        if bond:
            bond.shutdown()
