"""The node that a composition is for others: it loads and unloads programs by nodelet's services."""
import contextlib
from typing import Any

import rosgraph.names

from pharos.compose.composition import Composition
from pharos.compose.script import ScriptNode, source_of, why_apart
from pharos.errors import PharosError, UnknownNodeError, UnknownTypeError
from pharos.node import Node
from pharos.ros_process import find_program


class Container(Node):
    """Loads programs as nodelet's manager loads nodelets: ``nodelet load PACKAGE/EXECUTABLE NAME``.

    :param composition: whose nodes they will be
    """

    def __init__(self, composition: Composition):
        self.composition = composition
        self.loaded: dict[str, ScriptNode] = {}
        self._bonds: dict[str, Any] = {}

    def start(self):
        """Offer the services, if nodelet is installed."""
        super().start()
        with contextlib.suppress(UnknownTypeError):
            self.serve('~load_nodelet', 'nodelet/NodeletLoad', self._load)
            self.serve('~unload_nodelet', 'nodelet/NodeletUnload', self._unload)
            self.serve('~list', 'nodelet/NodeletList', lambda request: [*self._running()])

    def _running(self):
        return {name: node for name, node in self.loaded.items() if node.is_running}

    def _load(self, request):
        package, _, executable = request.type.partition('/')
        path = find_program(package, executable)
        reason = why_apart(path)
        if reason:
            raise PharosError(f'{path} cannot run here, since {reason}: run it as a process')
        name = full = self._full(request.name)
        if name in self._running():
            raise PharosError(f'{name} is loaded already: unload it first, or name another')
        if request._connection_header.get('callerid') == name:  # nodelet load has that name itself
            name += f'_in_{self.name.rpartition("/")[2]}'
            self.master.parameters[name] = self.master.parameters.get(full, {})
        remaps = zip(request.remap_source_args, request.remap_target_args)
        args = [*request.my_argv, *(f'{source}:={target}' for source, target in remaps)]
        args.append(f'__name:={name.rpartition("/")[2]}')
        self.loaded[full] = self.composition.start(name, source_of(path), args)
        if request.bond_id:  # which ends when whoever loaded it has gone
            bond = self._bonds[full] = self.ros_import('bondpy.bondpy').Bond(
                f'{self.name}/bond', request.bond_id, on_broken=lambda: self._drop(full)
            )
            bond.start()
        return True

    def _full(self, name):
        return rosgraph.names.resolve_name(name, self.name)

    def _unload(self, request):
        if self._full(request.name) not in self._running():
            raise UnknownNodeError(f'{request.name!r} is not loaded here: ~list names what is')
        self._drop(self._full(request.name))
        return True

    def _drop(self, name):
        node, bond = self.loaded.pop(name, None), self._bonds.pop(name, None)
        if node:
            node._end_now()
        if bond:
            bond.shutdown()
