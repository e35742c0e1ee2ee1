"""The workspace in a notebook: a real Jupyter kernel, without a browser."""
import sys
import threading

import pytest

from helpers import create
from pharos.testing import TIMEOUT, Mailbox, until
from programs import environment
from sockets import refused_url

manager = pytest.importorskip('jupyter_client.manager')
pytest.importorskip('ipykernel')


class Kernel:
    """A kernel, and what a notebook asks it."""

    def __init__(self, master_url, folder):
        self.manager = manager.KernelManager(
            connection_file=str(folder / 'kernel.json'),
            transport='ipc',  # for ports that are chosen beforehand others may take
            ip=str(folder / 'kernel'),
        )
        self.manager.kernel_spec.argv = [
            *(sys.executable, '-m', 'ipykernel_launcher', '-f', '{connection_file}')
        ]
        settings = environment(master_url, IPYTHONDIR=str(folder))
        self.manager.start_kernel(env=settings, cwd=str(folder))
        self.client = self.manager.client()
        self.client.start_channels()
        self.client.wait_for_ready(TIMEOUT)
        self.printed = ''

    def run(self, code):
        """Run a cell; returns what it shows, by MIME type, and its error's name and text."""
        shown = {}

        def note(message):
            content = message['content']
            if message['msg_type'] == 'stream':
                self.printed += content['text']
            elif message['msg_type'] in ('execute_result', 'display_data'):
                shown.update(content['data'])

        # after an error, a kernel that stops on errors refuses also the next cell, for a moment
        reply = self.client.execute_interactive(
            code, timeout=TIMEOUT, output_hook=note, stop_on_error=False
        )
        content = reply['content']
        if content['status'] == 'error':
            shown['error'] = f"{content['ename']}: {content['evalue']}"
        return shown

    def listen(self, text):
        """Wait until it has printed that between cells."""

        def is_there():
            message = self.client.get_iopub_msg(timeout=TIMEOUT)
            if message['msg_type'] == 'stream':
                self.printed += message['content']['text']
            return text in self.printed

        until(is_there)

    def complete(self, code):
        """What completes the end of a cell."""
        content = self.client.complete(code, reply=True, timeout=TIMEOUT)['content']
        return content['matches']

    def inspect(self, code):
        """What ``code?`` shows, as text."""
        content = self.client.inspect(code, reply=True, timeout=TIMEOUT)['content']
        return content['data']['text/plain']

    def end(self):
        """End it as a notebook that is closed does."""
        self.client.stop_channels()
        self.manager.shutdown_kernel()


@pytest.fixture
def kernel(master, tmp_path):
    """A kernel that is a workspace at the test's master, after one line."""
    kernel = Kernel(master.url, tmp_path)
    kernel.run('from pharos.live.workspace import start; start();')
    yield kernel
    kernel.end()
    assert '/workspace' not in {node.name for node in master.nodes()}


def test_one_line_makes_a_notebook_a_workspace(master, kernel):
    assert f'1 node is at the ROS master {master.url}' in kernel.printed
    assert kernel.run('me.name, master.url')['text/plain'] == f"('/workspace', '{master.url}')"
    assert '/workspace' in {node.name for node in master.nodes()}


def test_the_extension_makes_one_and_ends_it(master, kernel):
    assert kernel.run('%load_ext pharos.live.workspace') == {}
    assert kernel.run('me.name')['text/plain'] == "'/workspace'"
    kernel.run('%unload_ext pharos.live.workspace')
    assert '/workspace' not in {node.name for node in master.nodes()}


def test_a_notebook_completes_and_explains(master, kernel):
    turtle = create(master, '/turtle')
    turtle.interested_in('/turtle1/cmd_vel', 'geometry_msgs/Twist')
    assert kernel.complete("master.node('/tur") == ['/turtle']
    assert kernel.complete("me.send_to(\n  '/turtle1/") == ['/turtle1/cmd_vel']
    assert 'linear=' in kernel.complete("me.send_to('/turtle1/cmd_vel',\n           lin")
    kernel.run('topic = master.topic("/turtle1/cmd_vel")')
    assert '/turtle1/cmd_vel [geometry_msgs/Twist]' in kernel.inspect('topic')


def test_nodes_messages_and_graphs_are_shown_as_html_and_svg(master, kernel):
    assert '<b>/workspace: BlockNode, running' in kernel.run('me')['text/html']
    message = kernel.run("message_class('geometry_msgs/Point')(x=1.5)")
    assert '<caption>geometry_msgs/Point</caption>' in message['text/html']
    assert 'x: 1.5' in message['text/plain']
    assert kernel.run('master.graph()')['image/svg+xml'].startswith('<')


def test_an_image_is_shown_as_a_picture_and_not_as_a_table(kernel):
    shown = kernel.run(
        "message_class('sensor_msgs/Image')"
        "(width=2, height=1, step=6, encoding='rgb8', data=bytes(range(6)))"
    )
    assert shown['image/png']
    assert 'text/html' not in shown
    assert 'width: 2' in shown['text/plain']


def test_what_blocks_show_and_log_is_in_the_notebook(master, kernel):
    kernel.run(
        "hearer = me.interested_in('/texts', 'std_msgs/String', lambda m, c: "
        "(Transcript.show('shown', m.data), me.log('logged ' + m.data)));"
    )
    sender = create(master, '/sender').output_channel('/texts', 'std_msgs/String')
    sender.wait_for_subscribers(timeout=TIMEOUT)
    sender.send(data='hello')
    kernel.listen('shown hello')
    kernel.listen('logged hello')


@pytest.mark.parametrize('line', ['me.sleep(3600)', 'spin()', 'master.wait_for_node("/nobody")'])
def test_an_interrupt_ends_the_cell_and_no_node(master, kernel, line):
    begun = Mailbox(create(master, '/hearer'), '/begun', 'std_msgs/String')
    interrupt = threading.Thread(target=lambda: (begun.next(), kernel.manager.interrupt_kernel()))
    interrupt.start()
    kernel.run("me.output_channel('/begun', 'std_msgs/String').wait_for_subscribers()")
    shown = kernel.run(f"me.send_to('/begun')\n{line}")
    interrupt.join(TIMEOUT)
    assert shown['error'].startswith('KeyboardInterrupt')
    assert kernel.run('me.is_running')['text/plain'] == 'True'


def test_an_error_of_ours_is_shown_as_such(kernel):
    shown = kernel.run("master.node('/nobody')")
    assert shown['error'].startswith('UnknownNodeError: no node /nobody at ')


def test_a_notebook_without_a_master_has_one_of_its_own(master, tmp_path):
    kernel = Kernel(refused_url(), tmp_path)
    kernel.run('%load_ext pharos.live.workspace')
    assert 'this session has one of its own' in kernel.printed
    assert kernel.run('master.is_reachable()')['text/plain'] == 'True'
    kernel.end()
