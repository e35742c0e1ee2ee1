"""The node that a composition is for others: it loads and unloads programs by nodelet's services."""
import threading
from typing import TYPE_CHECKING, Any, Dict, List

import rosgraph.names

from pharos import node_registry
from pharos.compose.kept_node import KeptNode
from pharos.compose.launch_file import LaunchedNode
from pharos.compose.output import SCREEN
from pharos.compose.programs import find_program, uses_pharos
from pharos.errors import PharosError, UnknownNodeError, suggest
from pharos.node import Node

if TYPE_CHECKING:
    from pharos.compose.composition import Composition


class Container(Node):
    """Loads programs into a composition, as nodelet's manager does nodelets: ``nodelet load
    PACKAGE/EXECUTABLE NAME``, where NAME is this node's.

    :param composition: whose nodes they will be
    :param allow_remote_load: whether any host may ask for that, not only this one and the master's
    """

    def __init__(self, composition: 'Composition', allow_remote_load: bool = False) -> None:
        super().__init__()
        self.composition = composition
        self._only_nearby = not allow_remote_load
        # guards the two below, so that what is unloaded while it is being bound leaves no bond behind
        self._changing = threading.RLock()
        self._loaded: Dict[str, KeptNode] = {}
        self._bonds: Dict[str, Any] = {}

    def start(self) -> None:
        """Offer the services.

        :raises UnknownTypeError: if nodelet is not installed
        """
        super().start()
        self.serve('~load_nodelet', 'nodelet/NodeletLoad', self._load, self._only_nearby)
        self.serve('~unload_nodelet', 'nodelet/NodeletUnload', self._unload, self._only_nearby)
        self.serve('~list', 'nodelet/NodeletList', self._list)

    def _tell_failure(self, line: str, details: str) -> None:
        """Without a traceback: what is refused is no error of ours."""
        super()._tell_failure(line, '')

    def _load(self, request: Any) -> bool:
        package, _, executable = request.type.partition('/')
        if not package or not executable or '/' in executable:
            raise PharosError(f'{request.type!r} names no program: it is to be PACKAGE/EXECUTABLE')
        path = find_program(package, executable)
        if uses_pharos(path):
            raise PharosError(
                f'{request.type} makes its nodes itself, with pharos, and they would not be unloaded'
                ' with it: start it as a process of its own'
            )
        full_name = self._full_name(request.name)
        if full_name in self._running():
            raise PharosError(f'{full_name} is loaded already: unload it first, or name another')
        if len(request.remap_source_args) != len(request.remap_target_args):
            raise PharosError('there are not as many sources of remappings as targets')
        remaps = zip(request.remap_source_args, request.remap_target_args)
        name = full_name
        if request._connection_header.get('callerid') == name:
            # `nodelet load` has that name itself, for as long as this is loaded
            name += f"_in_{self.name.rpartition('/')[2]}"
        launched = LaunchedNode(
            name=name,
            program=request.type,
            path=path,
            args=[*request.my_argv, *(f'{source}:={target}' for source, target in remaps)],
            private_name=full_name,
            output=SCREEN,
        )
        (kept,) = self.composition.start([launched])
        kept.settled.wait()
        if kept.problem is not None:
            raise kept.problem
        with self._changing:
            self._loaded[full_name] = kept
            if request.bond_id:
                try:
                    self._bind(full_name, request.bond_id)
                except BaseException:
                    self._drop(full_name)
                    raise
        return True

    def _full_name(self, name: str) -> str:
        """A name, in the namespace of this node if it does not say in which."""
        may_be_one = name and name[0] not in '~/'  # else it is told what is wrong with it
        return str(rosgraph.names.resolve_name(name, self.name)) if may_be_one else name

    def _bind(self, name: str, bond_id: str) -> None:
        """Unload it when whoever loaded it has gone, and have them know when it has ended."""
        bond = self._bonds[name] = self.ros_import('bondpy.bondpy').Bond(
            f'{self.name}/bond', bond_id, on_broken=lambda: self._drop(name)
        )
        bond.start()
        kept = self._loaded[name]
        self.fork(lambda me: self._drop_at_its_end(name, kept), name=f'bond of {name}')

    def _drop_at_its_end(self, name: str, kept: KeptNode) -> None:
        node_registry.wait_until(lambda: kept.is_over)
        if (
            kept.is_over and self._loaded.get(name) is kept
        ):  # else this node stops, or it was dropped
            self._drop(name)

    def _drop(self, name: str) -> None:
        with self._changing:
            kept, bond = self._loaded.pop(name, None), self._bonds.pop(name, None)
        if kept is not None:
            kept.stop()
        if bond is not None:
            bond.shutdown()

    def _unload(self, request: Any) -> bool:
        name = self._full_name(request.name)
        if name not in self._loaded:
            raise UnknownNodeError(f'{name!r} is not loaded here{suggest(name, self._loaded)}')
        self._drop(name)
        return True

    def _list(self, request: Any) -> List[str]:
        return self._running()

    def _running(self) -> List[str]:
        loaded = {id(kept): name for name, kept in self._loaded.items()}
        return [
            loaded.get(id(kept), kept.name) for kept in self.composition.kept if not kept.is_over
        ]
