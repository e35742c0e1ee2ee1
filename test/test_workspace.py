"""The workspace: a session in a real terminal, in which robots are programmed while they run."""
import contextlib
import os
import re
import signal
import subprocess
import sys
import time

import psutil
import pytest

from helpers import create
from pharos import BlockNode
from pharos.live import workspace
from pharos.testing import TIMEOUT, Mailbox, until
from programs import PROGRAMS, environment, run, script
from sockets import refused_url
from terminal import Terminal

NODES = PROGRAMS / 'at_the_prompt.py'


@pytest.fixture
def open_session(master):
    """Opens a session in a terminal, at the test's master, and waits for its prompt; the program
    ends with the test."""
    terminals = []

    def open_session(*arguments, url=master.url, prompt=r'^In \[1\]:', command=None, **variables):
        command = command or [sys.executable, script('workspace')]
        terminals.append(Terminal(url, *command, *arguments, **variables))
        terminals[-1].wait_for(prompt)
        return terminals[-1]

    yield open_session
    for terminal in terminals:
        if terminal.status is None:
            os.kill(terminal.pid, signal.SIGTERM)
            with contextlib.suppress(TimeoutError):  # IPython itself takes it for the line's end
                terminal.wait()
        terminal.close()


def names(master):
    return {node.name for node in master.nodes()}


def leave(terminal):
    """Leave a session as one does; returns the status, and how many seconds it took."""
    began = time.monotonic()
    terminal.press('C-d')
    terminal.wait_for('Do you really want to exit')
    terminal.press('Enter')
    return terminal.wait(), time.monotonic() - began


def interrupt(terminal):
    """Press Ctrl-C until the line has ended.

    Python does not notice one that comes while its main thread waits for its turn right before a
    ``time.sleep()``, until that ends.
    """
    pressed = []

    def is_interrupted():
        if not pressed or time.monotonic() > pressed[-1] + 2:
            terminal.press('C-c')
            pressed.append(time.monotonic())
        return re.search('^KeyboardInterrupt', terminal.text, re.MULTILINE)

    until(is_interrupted)


# -- what a session has


def test_a_session_has_a_master_a_node_of_its_own_and_all_of_pharos(master, open_session):
    terminal = open_session()
    terminal.enter('print(master.url, me.name, Node, ScriptNode, pharos.__version__)')
    terminal.wait_for(
        f"^{re.escape(master.url)} /workspace <class 'pharos.node.Node'>"
        " <class 'pharos.compose.script.ScriptNode'> "
    )
    assert '/workspace' in names(master)
    assert f': 1 node is at the ROS master {master.url}' in terminal.text


def test_a_second_session_has_another_name(master, open_session):
    open_session()
    second = open_session()
    second.enter('me.name')
    second.wait_for("^Out.*'/workspace_2'$")
    assert names(master) >= {'/workspace', '/workspace_2'}


def test_a_session_is_named_as_rosrun_says(master, open_session):
    open_session('__name:=lab')
    assert '/lab' in names(master)


def test_a_session_without_a_master_has_one_of_its_own(open_session):
    terminal = open_session(url=refused_url())
    terminal.wait_for('no ROS master answers at')
    url = terminal.wait_for(r'export ROS_MASTER_URI=(\S+)')[1]
    terminal.enter('import os', 'Master().url == master.url == os.environ["ROS_MASTER_URI"]')
    terminal.wait_for('^Out.*True')
    pid = int(run(url, sys.executable, '-c', 'import pharos; print(pharos.Master().pid)').stdout)
    status, seconds = leave(terminal)
    assert status == 0
    assert not psutil.pid_exists(pid)


def test_the_names_of_a_session_can_be_had_in_a_program(master):
    with workspace.Workspace(master.url) as session:
        names = session.namespace
        assert names['master'] == master
        assert names['me'] is master.node('/workspace')
        assert names['BlockNode'] is BlockNode
    assert not session.me.is_running
    assert 'me' not in workspace.namespace(master)


# -- what is printed meanwhile


def test_what_blocks_show_log_and_print_comes_above_the_line_that_is_typed(master, open_session):
    terminal = open_session(NODES)
    sender = create(master, '/sender').output_channel('/texts', 'std_msgs/String')
    sender.wait_for_subscribers(timeout=TIMEOUT)
    terminal.type('half a line')
    terminal.wait_for(r'^In \[1\]: half a line$')
    for number in range(3):
        sender.send(data=f'text {number}')
        for pattern in (
            f'shown text {number}',
            rf'\[INFO\].*: logged text {number}',
            f'printed text {number}',
        ):
            terminal.wait_for(f'^{pattern}$')
        terminal.wait_for(rf'printed text {number}\n(.*\n)*In \[1\]: half a line\Z')
    terminal.enter('\b' * 11 + '6 * 7')
    terminal.wait_for(r'^Out\[1\]: 42$')


def test_what_blocks_show_comes_above_the_line_that_is_typed_to_the_debugger(master, open_session):
    terminal = open_session(NODES)
    terminal.enter('telling.interested_in("/wrong", "std_msgs/Empty") and None')
    terminal.wait_for(r'^In \[2\]:')
    create(master, '/erring').send_to('/wrong', typed_as='std_msgs/Empty')
    terminal.wait_for('AttributeError')
    terminal.enter('telling.failures[0].debug()')
    terminal.wait_for(r'^ipdb>')
    terminal.type('p "half')
    terminal.wait_for(r'^ipdb> +p "half$')
    sender = create(master, '/sender').output_channel('/texts', 'std_msgs/String')
    sender.wait_for_subscribers(timeout=TIMEOUT)
    sender.send(data='meanwhile')
    terminal.wait_for(r'^printed meanwhile\n(.*\n)*ipdb> +p "half\Z')
    terminal.enter(' a line", message')
    terminal.wait_for(r"^\('half a line', ")
    terminal.enter('q', '6 * 7')
    terminal.wait_for('^Out.*: 42$')


def test_log_lines_go_where_the_process_prints_then(master, capfd):
    node = create(master, '/teller')
    node.log('first')
    with open(os.devnull, 'w', encoding='utf-8') as nowhere:
        before, sys.stdout = sys.stdout, nowhere
        try:
            node.log('second')
        finally:
            sys.stdout = before
    node.log('third')
    assert re.findall(r': (\w+)\n', capfd.readouterr().out) == ['first', 'third']


def test_what_a_script_node_prints_comes_above_the_line(master, open_session, tmp_path):
    (tmp_path / 'printing.py').write_text(
        "import rospy, std_msgs.msg\nrospy.init_node('printing')\n"
        "def told(message): print('script says', message.data)\n"
        "rospy.Subscriber('/texts', std_msgs.msg.String, told)\nrospy.spin()\n"
    )
    terminal = open_session()
    terminal.enter(f'p = master.load({str(tmp_path / "printing.py")!r})')
    master.wait_for_node('/printing', TIMEOUT)
    terminal.wait_for(r'^In \[2\]:')
    terminal.type('half')
    sender = create(master, '/sender').output_channel('/texts', 'std_msgs/String')
    sender.wait_for_subscribers(timeout=TIMEOUT)
    sender.send(data='hello')
    terminal.wait_for(r'^script says hello\n(.*\n)*In \[2\]: half\Z')


# -- mistakes


@pytest.fixture
def told(master):
    """What a session tells of lines, without the lines that it shows anyway."""

    def told(*lines):
        session = subprocess.run(
            [sys.executable, script('workspace')],
            input='%colors NoColor\n' + '\n'.join(lines) + '\n',
            env=environment(master.url),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
        return session.stdout.partition('to its end.\n')[2]

    return told


def test_a_mistake_is_told_by_the_line_and_one_sentence(master, told):
    create(master, '/hearer').interested_in('/tw', 'geometry_msgs/Twist')
    text = told("me.send_to('/tw', linear=3)")
    assert '----> 1 me.send_to(' in text
    assert 'MessageTypeError: geometry_msgs/Twist.linear = 3 does not fit' in text
    assert text.count('\n') < 12, text
    assert 'src/pharos' not in text
    text = told('me.delgate')
    assert "no attribute 'delgate' (did you mean 'delegate'?)" in text
    assert 'src/pharos' not in text
    text = told("me.send_to('/tw', linear=3)", '%tb')  # and that shows all
    assert 'src/pharos' in text


def test_the_line_in_a_function_of_the_users_is_shown_and_what_is_no_mistake_as_ever(told):
    text = told(
        'def ask():', '    return master.parameters["no"]', '', 'ask()', '{}["no"]', '1 / 0'
    )
    assert '----> 2     return master.' in text or '----> 2 return master.' in text
    assert 'src/pharos' not in text
    assert text.count('KeyError') > 1
    assert 'ZeroDivisionError' in text


# -- completion and ?


def complete(terminal, typed, completed):
    """Type, press Tab, and wait for the line that comes of it; then give that up."""
    terminal.type(typed)
    terminal.press('Tab')
    terminal.wait_for(rf'^In \[\d+\]: {re.escape(completed)}')
    terminal.press('C-c', 'C-c')  # the first may only end the choice between several words


def test_tab_completes_names_of_the_graph_fields_and_types(master, open_session):
    turtle = create(master, '/turtle_of_tab')
    turtle.interested_in('/turtle1/cmd_vel', 'geometry_msgs/Twist')
    turtle.serve('/clear_of_tab', 'std_srvs/Empty', lambda request: None)
    terminal = open_session()
    complete(terminal, "master.node('/tur", "master.node('/turtle_of_tab")
    complete(terminal, "me.send_to('/turtle1/", "me.send_to('/turtle1/cmd_vel")
    complete(
        terminal, "me.send_to('/turtle1/cmd_vel', lin", "me.send_to('/turtle1/cmd_vel', linear="
    )
    complete(terminal, "master.lookup_service('/cl", "master.lookup_service('/clear_of_tab")
    complete(
        terminal, "message_class('geometry_msgs/Quat", "message_class('geometry_msgs/Quaternion"
    )
    complete(terminal, 'master.wait_for_n', 'master.wait_for_node')


def test_tab_lists_fields_alone_where_nothing_is_typed_and_first_where_something_is(
    master, open_session
):
    create(master, '/turtle_of_tab').interested_in('/turtle1/cmd_vel', 'geometry_msgs/Twist')
    terminal = open_session()
    terminal.type("me.send_to('/turtle1/cmd_vel', ")
    terminal.press('Tab')
    terminal.wait_for(r"cmd_vel', *\n +angular= *\n +linear=\Z")
    terminal.press('C-c', 'C-c')
    terminal.enter('another = 1')
    terminal.type("me.send_to('/turtle1/cmd_vel', a")
    terminal.press('Tab')
    terminal.wait_for(r'^ +angular= +(.*)another')


def test_tab_completes_fields_in_a_later_line_of_a_call(master, open_session):
    create(master, '/turtle_of_tab').interested_in('/turtle1/cmd_vel', 'geometry_msgs/Twist')
    terminal = open_session()
    terminal.enter("me.send_to('/turtle1/cmd_vel',")
    terminal.wait_for(r'^ +\.\.\.: $|^ +\.\.\.:')
    terminal.type('ang')
    terminal.press('Tab')
    terminal.wait_for(r'^ +\.\.\.: +angular=')


def test_tab_at_a_master_that_has_gone_completes_nothing_and_says_nothing(
    mortal_master, open_session
):
    terminal = open_session('__name:=robot_shell', url=mortal_master.url)  # which is no file's name
    mortal_master.end()
    terminal.type("master.node('/robot_")
    terminal.press('Tab')
    terminal.type('shell')
    terminal.wait_for(r"^In \[1\]: master.node\('/robot_shell\Z")


def test_a_question_mark_tells_of_a_topic_and_two_what_it_is_beside(master, open_session):
    create(master, '/turtle').interested_in('/turtle1/cmd_vel', 'geometry_msgs/Twist')
    terminal = open_session()
    terminal.enter('topic = master.topic("/turtle1/cmd_vel")', 'topic?')
    terminal.wait_for(r'^/turtle1/cmd_vel \[geometry_msgs/Twist\]\n  fields\n    linear: ')
    assert 'heard by /turtle' in terminal.text
    terminal.enter('topic??')
    terminal.wait_for('class Topic:')


def test_what_is_long_is_shown_where_there_is_no_pager(open_session, tmp_path, monkeypatch):
    monkeypatch.delenv('PAGER', raising=False)
    (tmp_path / 'sh').symlink_to('/bin/sh')
    terminal = open_session(PATH=str(tmp_path))
    terminal.enter('lines = "as always\\n" * 7000 + "the last"', '%page -r lines')
    terminal.wait_for('^the last$')


# -- Ctrl-C, the ends

LINES = [
    'me.sleep(3600)',
    'spin()',
    'time.sleep(3600)',
    'master.wait_for_node("/nobody")',
    'master.lookup_service("/never_answers").call()',
]


@pytest.mark.parametrize(
    'command', [None, [sys.executable, '-m', 'IPython', '-i'], [sys.executable, '-i']]
)
@pytest.mark.parametrize('line', LINES)
def test_ctrl_c_ends_the_line_and_no_node(master, open_session, command, line):
    terminal = open_session(NODES, command=command, prompt=r'^(In \[1\]:|>>>)')
    terminal.enter('print("be" "gun"); ' + line)
    terminal.wait_for('^begun$')
    begun = Mailbox(create(master, '/hearer'), '/begun', 'std_msgs/String')
    interrupt(terminal)
    terminal.enter('print("still", me.lifecycle.value, ticking.lifecycle.value)')
    terminal.wait_for('^still running running')
    assert begun.next()  # a soul of it goes on


def test_ctrl_c_at_the_prompt_ends_no_node(master, open_session):
    terminal = open_session(NODES)
    terminal.type('half a line')
    terminal.press('C-c')
    terminal.enter('ticking.is_running')
    terminal.wait_for('^Out.*True')


def test_ctrl_c_ends_a_script_that_spins_and_the_session_goes_on(master, open_session):
    terminal = open_session(script('turtle_driver'), prompt='PhaROS')
    terminal.wait_for('waits for a turtle')  # it is past its start, which Ctrl-C would end
    terminal.press('C-c')
    terminal.wait_for(r'^In \[1\]:')
    terminal.enter('master.node("/my_turtle_driver").is_running')
    terminal.wait_for('^Out.*True')


def test_leaving_stops_what_was_made_and_leaves_nothing(master, open_session):
    terminal = open_session(NODES)
    terminal.enter('child = Master.embedded()')
    terminal.enter('child.pid')
    pid = int(terminal.wait_for(r'^Out\[2\]: (\d+)')[1])
    status, seconds = leave(terminal)
    assert status == 0
    assert seconds < 5
    assert names(master) & {'/workspace', '/ticking'} == set()
    assert not psutil.pid_exists(pid)


def test_exit_leaves_too(master, open_session):
    terminal = open_session()
    terminal.enter('exit')
    assert terminal.wait() == 0
    assert '/workspace' not in names(master)


@pytest.mark.parametrize('line', ['', 'me.sleep(3600)', 'time.sleep(3600)'])
@pytest.mark.parametrize('with_signal', [signal.SIGTERM, signal.SIGHUP], ids=lambda each: each.name)
def test_a_signal_ends_the_session_and_the_terminal_is_as_before(
    master, open_session, with_signal, line
):
    command = f'{sys.executable} {script("workspace")} {NODES}; echo status $?; stty -a; cat'
    terminal = open_session(command=['sh', '-c', command])
    if line:
        terminal.enter('print("be" "gun"); ' + line)
        terminal.wait_for('^begun$')
    (session,) = psutil.Process(terminal.pid).children()
    os.kill(session.pid, with_signal)
    status = terminal.wait_for(r'^status (\d+)')[1]
    assert int(status) in (128 + with_signal, 128 + signal.SIGTERM)
    terminal.wait_for(r'[; ]icanon')
    terminal.wait_for(r'[; ]echo ')
    assert names(master) & {'/workspace', '/ticking'} == set()


# -- scripts


@pytest.mark.parametrize('with_signal', [signal.SIGTERM, signal.SIGHUP], ids=lambda each: each.name)
def test_a_signal_ends_a_session_in_which_a_failure_is_debugged(master, open_session, with_signal):
    terminal = open_session()
    terminal.enter('me.soul = lambda me: 1 / 0', 'me.execute()', 'me.failures[0].debug()')
    terminal.wait_for('^ipdb>')
    os.kill(terminal.pid, with_signal)
    assert terminal.wait() in (128 + with_signal, 128 + signal.SIGTERM)
    assert '/workspace' not in names(master)


def test_a_script_has_the_names_of_the_session_and_its_arguments(open_session, tmp_path):
    path = tmp_path / 'first.py'
    path.write_text('import sys\nanswer = [me.name, __name__, sys.argv[1:]]\n')
    terminal = open_session(path, '--fast', '3')
    terminal.enter('answer')
    terminal.wait_for(r"^Out.*\['/workspace', '__main__', \['--fast', '3'\]\]")


def test_a_script_knows_its_file_as_its_functions_do_later(open_session, tmp_path):
    path = tmp_path / 'first.py'
    path.write_text('where = __file__\ndef later(): return __file__\n')
    terminal = open_session(path)
    terminal.enter(f'where == later() == {str(path)!r}')
    terminal.wait_for('^Out.*True')


@pytest.mark.parametrize(
    'error, told',
    [
        ('raise ValueError("odd")', 'ValueError: odd'),
        ('import sys; sys.exit("odd")', "failing.py has ended: sys.exit\\('odd'\\)"),
        ('import sys; sys.exit(3)', r'failing.py has ended: sys.exit\(3\)'),
        ('import sys; sys.exit(0)', ''),
    ],
)
def test_the_error_of_a_script_leaves_the_session_open(open_session, tmp_path, error, told):
    path = tmp_path / 'failing.py'
    path.write_text(f'before = 1\n{error}\n')
    terminal = open_session(path)
    terminal.wait_for(told)
    terminal.enter('before')
    terminal.wait_for('^Out.*1')
    assert 'safe_execfile' not in terminal.text
    assert ('Traceback' in terminal.text) == ('ValueError' in error)
    assert leave(terminal)[0] == 0


# -- where there is no session


def test_a_script_that_is_not_there_is_an_error(master):
    ended = run(master.url, sys.executable, script('workspace'), 'missing.py')
    assert (ended.returncode, ended.stdout) == (1, '')
    assert ended.stderr == (
        'workspace: there is no script missing.py: give the path of a Python program\n'
    )


def test_a_malformed_master_uri_is_an_error():
    ended = run('robot:11311', sys.executable, script('workspace'))
    assert ended.returncode == 1
    assert re.fullmatch('workspace: .*ROS_MASTER_URI.*\n', ended.stderr)


def test_without_ipython_it_says_what_to_install(master, tmp_path):
    code = (
        f'import sys; sys.modules["IPython"] = None; sys.path.insert(0, {script("")!r}); '
        f'exec(open({script("workspace")!r}).read())'
    )
    ended = run(master.url, sys.executable, '-c', code)
    assert ended.returncode == 1
    assert re.fullmatch('workspace: .*: sudo apt-get install python3-ipython\n', ended.stderr)


def run_without_terminal(master, lines, *arguments):
    """Have a session run these lines; returns what it printed and its status."""
    return subprocess.run(
        [sys.executable, script('workspace'), *map(str, arguments)],
        input=lines,
        env=environment(master.url),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )


def test_without_a_terminal_the_lines_of_its_input_are_run(master):
    ended = run_without_terminal(
        master,
        'x = 6\nfor i in range(2):\n    x += 1\n\nprint(me.name, x)\n1 / 0\nprint("after")\n',
    )
    assert 'Standard input is no terminal' in ended.stdout
    assert '/workspace 8' in ended.stdout
    assert 'ZeroDivisionError' in ended.stdout + ended.stderr
    assert 'after' in ended.stdout
    assert ended.returncode == 1
    assert '/workspace' not in names(master)
    assert '\x1b' not in ended.stdout + ended.stderr


@pytest.mark.parametrize(
    'code, status', [('1 / 0', 1), ('exit(3)', 3), ('exit(0)', 0), ('exit("odd")', 1), ('x = 1', 0)]
)
def test_without_a_terminal_its_status_is_that_of_the_script(master, tmp_path, code, status):
    path = tmp_path / 'script.py'
    path.write_text(f'from sys import exit\n{code}\n')
    ended = run_without_terminal(master, 'print(6 * 7)\n', path)
    assert ended.returncode == status
    assert '42' in ended.stdout
