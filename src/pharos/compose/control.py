"""Stop, start, restart and reload the nodes of a composition.

Other processes of the same user may ask for it; a saved file may, too.
Each composition listens on a socket that is not in a file system; its name has the process's number.
"""
from __future__ import annotations

import contextlib
import os
import re
import socket
import threading
from typing import TYPE_CHECKING, Any

from pharos.errors import PharosError, UnknownNodeError
from pharos.live.editing import NO_CHANGE, editable_modules
from pharos.private_rospy.tcpros import accept_clients, check_user
from pharos.transcript import Transcript, attempt

if TYPE_CHECKING:
    from pharos.compose.composition import Composition
    from pharos.master import Master

ANSWER_LIMIT = 60.0  # seconds
MAX_TEXT = 65536  # bytes
SAVE_PERIOD = 0.05  # seconds between two looks at the files
_PREFIX = 'pharos-compose-'
DONE = 'done: '


def listen(composition: Composition) -> socket.socket:
    """Obey other processes, in a thread, until the composition has stopped."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listener.bind(f'\0{_PREFIX}{os.getpid()}')
        listener.listen()
        threading.Thread(target=_serve, args=[listener, composition], daemon=True).start()
    except OSError as error:  # such as for a second composition of this process
        Transcript.show(
            'restart, stop and reload do not reach this composition: another one of this process or'
            f' another user has the control name ({error})'
        )
    return listener


def _serve(listener: socket.socket, composition: Composition) -> None:
    def obey(client: socket.socket, address: object) -> None:
        threading.Thread(target=_obey, args=[client, composition], daemon=True).start()

    with listener:
        accept_clients(listener, composition.stopping, obey)


def _obey(client: socket.socket, composition: Composition) -> None:
    client.settimeout(ANSWER_LIMIT)
    with client, contextlib.suppress(OSError, ValueError):  # it has gone, or sends nonsense
        check_user(client)
        action, name, url = client.recv(MAX_TEXT).decode().split()
        if url == composition.master.url:
            client.send(_answer(composition, action, name).encode())


def _answer(composition: Composition, action: str, name: str) -> str:
    """Do what a client wants, and return the text for it; '' if the node is not of this composition."""
    for node in composition.nodes:
        if name in (node._settings.name, *node.created_names):
            try:
                return DONE + composition.control(node, action)
            except PharosError as error:
                return str(error)
    return ''


def reload_on_save(composition: Composition) -> None:
    """Reload the nodes of this process whose files are saved, until the composition stops."""
    saves = {}  # node -> times and sizes of its files: of the last reload, and of the last look
    while not composition.stopping.wait(SAVE_PERIOD):
        for node in composition.nodes:
            if node.is_running:
                attempt(_reload_if_saved, composition, node, saves)


def _reload_if_saved(composition: Composition, node: Any, saves: dict) -> None:
    with contextlib.suppress(FileNotFoundError):  # an editor is about to replace a file
        files = [os.stat(module.__file__) for module in editable_modules(node)]
        save = [(file.st_mtime, file.st_size) for file in files]
        reloaded, last = saves.setdefault(node, (save, save))
        saves[node] = reloaded, save
        if reloaded != save == last:  # else the editor may still write
            saves[node] = save, save
            answer = _answer(composition, 'reload', node.name)
            # nothing: as when the program has imported one more module
            if answer != f'{DONE}{NO_CHANGE}':
                Transcript.show(node.name, answer)


def control(action: str, name: str, master: Master) -> str:
    """Restart, stop, start or reload a node of any composition of this user on this host, at a master.

    :param action: 'restart', 'stop', 'start' or 'reload'
    :param name: the full name
    :returns: the name of the node of the program, which may have created the node with pharos; of a
        reload, what :meth:`Node.reload` returns
    :raises UnknownNodeError: if no such composition has the node
    :raises PharosError: if the node does not start, or its program cannot be read
    """
    with open('/proc/net/unix') as file:
        socket_names = set(re.findall(f'@({_PREFIX}\\d+)', file.read()))
    for socket_name in socket_names:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
            sock.settimeout(ANSWER_LIMIT)
            try:
                sock.connect(f'\0{socket_name}')
                check_user(sock)
                sock.send(f'{action} {name} {master.url}'.encode())
                answer = sock.recv(MAX_TEXT).decode()
            except OSError:  # it belongs to another user, or ends
                continue
        if answer.startswith(DONE):
            return answer[len(DONE) :]
        if answer:
            raise PharosError(answer)
    raise UnknownNodeError(
        f'{name} is not a node of a composition of this user on this host at {master.url}:'
        ' see rosrun pharos top'
    )
