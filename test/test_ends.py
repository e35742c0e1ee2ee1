"""The end of a program in this process: its children, its threads, and how long others wait."""
import os
import signal
import time

import psutil
import pytest

from helpers import INIT, SPIN, TIMEOUT, end
from pharos.testing import until


def test_thread_that_blocks_for_ever_is_told(bench, transcript):
    reading_end, writing_end = os.pipe()
    text = f'''
        rospy.init_node('program')
        threading.Thread(target=os.read, args=[{reading_end}, 1], name='blocked', daemon=True).start()
        rospy.spin()
        '''
    bench.load(text).stop()
    os.close(writing_end)
    os.close(reading_end)
    (line,) = [line for line in transcript if 'leaves threads' in line]
    assert line.endswith('with what they use: blocked')


@pytest.mark.parametrize('rest', ['rospy.spin()', 'rospy.sleep(0.5)'])
def test_child_is_interrupted_at_the_end(bench, rest):
    text = f'''
        import subprocess
        rospy.init_node('program')
        child = subprocess.Popen(['sh', '-c', 'trap "exit 3" INT; sleep 60 & wait'])
        say(child.pid)
        {rest}
        '''
    script = bench.load(text)
    bench.until(bench.said)
    child = psutil.Process(int(bench.said()[0]))
    if 'spin' in rest:
        script.stop()
    script.wait(TIMEOUT)
    until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


def test_forked_child_ends_nothing_of_its_parents(master, bench):
    text = '''
        rospy.init_node('program')
        pid = os.fork()
        if not pid: os._exit(5)
        say(os.waitpid(pid, 0)[1] >> 8)
        rospy.spin()
        '''
    script = bench.load(text)
    bench.until(lambda: bench.said() == ['5'])
    assert script.is_running and '/program' in [each.name for each in master.nodes()]


@pytest.mark.parametrize('number', ['SIGINT', 'SIGTERM'])
def test_signal_to_its_own_process_ends_the_program_alone(bench, number):
    text = f'''
        rospy.init_node('program')
        rospy.on_shutdown(lambda: say('hook'))
        os.kill(os.getpid(), 0)
        os.kill(os.getpid(), signal.{number})
        rospy.spin()
        say('ended')
        '''
    script = bench.load(text)
    script.wait(TIMEOUT)
    assert bench.said()[0] == 'hook'
    until(lambda: not script.is_running)


@pytest.mark.parametrize('rest', ['', 'rospy.spin()'], ids=['by itself', 'by a stop'])
def test_print_in_a_destructor_at_the_end(bench, capfd, rest):
    """As of a driver whose __del__ prints, and turns its motor off."""
    text = f"""
        class Motor:
            def __del__(self):
                print('motor off')
                say('off')
        rospy.init_node('program')
        motor = Motor()
        say('on')
        {rest}
        """
    script = bench.load(text)
    bench.until(bench.said)
    script.stop()
    bench.until(lambda: bench.said() == ['on', 'off'])
    assert '[/program] motor off\n' in capfd.readouterr().out


def test_hook_that_raises_is_printed_and_kept(bench, capfd):
    text = '''
        def hook(): return 1 / 0
        rospy.init_node('program')
        rospy.on_shutdown(lambda: say('first'))
        rospy.on_shutdown(hook)
        rospy.on_shutdown(lambda: say('last'))
        rospy.spin()
        '''
    script = bench.load(text)
    script.stop()
    assert bench.said() == ['first', 'last']
    assert [type(error) for error in script.errors] == [ZeroDivisionError]
    assert 'ZeroDivisionError: division by zero' in capfd.readouterr().err


def test_system_default_of_sigint_ends_at_once(bench):
    text = '''
        rospy.init_node('program')
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        rospy.on_shutdown(lambda: say('hook'))
        atexit.register(lambda: say('atexit'))
        say('ready')
        while True: time.sleep(0.01)
        '''
    script = bench.load(text)
    bench.until(lambda: bench.said() == ['ready'])
    script.stop()
    assert bench.said() == ['ready']


def test_interrupt_while_roslaunch_starts_ends_its_nodes(master, bench):
    # not in Python, which may lose a KeyboardInterrupt while it imports: roslaunch waits 15 s then
    bench.write(f'#!/bin/sh\necho $$ >> {bench.folder}/said\nexec sleep 1000\n', head='')
    names = [f'node{number}' for number in range(6)]
    xml = ''.join(f'<node pkg="bench" type="program" name="{name}"/>' for name in names)
    with bench.program(bench.launch_file(xml), '--apart', *names) as composed:
        composed.until(lambda: 'process[node0' in composed.output)
        begin = time.monotonic()
        end(composed)
        assert time.monotonic() - begin < 10
    assert not any(psutil.pid_exists(int(pid)) for pid in bench.said())


def assert_ends_within(bench, seconds, text):
    """In one of three runs, Ctrl-C ends the program so soon: the computer may be busy."""
    for run in range(1, 4):
        with bench.program('--script', bench.write(text)) as composed:
            bench.until(lambda run=run: bench.said().count('ready') == run)
            begin = time.monotonic()
            end(composed)
            duration = time.monotonic() - begin
        if duration < seconds:
            return composed.output
    pytest.fail(f'it ends after {duration} s')


def test_end_waits_for_no_thread_that_blocks_and_for_no_lock_of_the_main_loop(bench):
    text = '''
        import queue
        lock = threading.Lock()
        rospy.init_node('program')
        rospy.on_shutdown(lambda: [lock.acquire(), lock.release()])
        threading.Thread(target=queue.Queue().get, daemon=True).start()
        rospy.loginfo('begins')
        say('ready')
        while not [lock.acquire(), rospy.is_shutdown(), lock.release()][1]: sum(range(10**5))
        '''
    output = assert_ends_within(bench, 10, text)
    (line,) = [line for line in output.splitlines() if 'begins' in line]
    assert line.count('program') == 1 and 'leaves' not in output


def test_end_waits_for_no_thread_of_a_library(bench):
    text = '''
        import socket, socketserver
        class Handler(socketserver.BaseRequestHandler):
            def handle(self): self.request.recv(100)
        rospy.init_node('program')
        server = socketserver.ThreadingTCPServer(('127.0.0.1', 0), Handler)
        rospy.on_shutdown(server.shutdown)
        client = socket.create_connection(server.server_address)
        threading.Thread(target=lambda: [time.sleep(0.1), say('ready')], daemon=True).start()
        server.serve_forever()
        '''
    assert_ends_within(bench, 5, text)


@pytest.mark.parametrize(
    'sleep', ['rospy.sleep(1000)', 'time.sleep(1000)', 'rospy.Rate(1e-3).sleep()']
)
def test_daemon_thread_sleeps_on_at_the_end(bench, sleep):
    """It runs no further line: a process would be gone."""
    text = f"""
def work():
    say('ready')
    {sleep}
    say('it goes on')
threading.Thread(target=work, daemon=True).start()
rospy.spin()
"""
    script = bench.load(INIT + text)
    until(bench.said)
    script.stop()
    assert bench.said() == ['ready'] and not script.failures


def test_slow_end_is_told(bench):
    text = "rospy.init_node('program')\nrospy.on_shutdown(lambda: time.sleep(4))\n"
    text += "rospy.sleep(0.5)\n" + SPIN
    with bench.program('--script', bench.write(text)) as composed:
        bench.until(lambda: 'ready' in bench.said())
        end(composed)
    assert 'the end waits for /program; a further Ctrl-C ends all at once' in composed.output


@pytest.mark.parametrize('option', ['--apart', '--group'])
def test_nodes_end_with_a_killed_composition(master, bench, option):
    path = bench.launch_file(program=INIT + "say('ready')\nrospy.spin()\n")
    with bench.program(path, option, 'program') as composed:
        bench.until(bench.said)
        os.kill(composed.pid, signal.SIGKILL)
        until(lambda: not any(master.system_state()))
