"""Virtual time: unmodified programs run as fast as they can, and say the same each time."""
import contextlib
import os
import pathlib
import queue
import re
import runpy
import signal
import sys
import textwrap
import threading
import time

import genpy
import pexpect
import pytest
import rosbag
import sensor_msgs.msg
import std_msgs.msg

from helpers import COMPOSE, INIT, PYTHON, ROOT, SPIN, TIMEOUT, Program
from pharos import BlockNode, PharosError, testing
from pharos.simulation import Simulation
from pharos.simulation.comparing import differences
from pharos.testing import Mailbox

PROGRAMS = ROOT / 'test' / 'programs' / 'virtual'
STRING = 'std_msgs/String'
ENDLESS = 1e9
master = testing.master  # these tests need a master of their own
create_node = testing.create_node
simulation = testing.simulation


def messages_of(simulation, topics, seconds):
    """Let the time go by, and return the messages as text, each with its topic and time."""
    texts = []

    def hear(message, channel):
        texts.append(f'{channel.topic} {simulation.now} {message}')

    with simulation.master.create(BlockNode, 'ear') as ear:
        for topic, type_ in topics.items():
            ear.interested_in(topic, type_, hear)
        simulation.run(seconds)
    assert simulation.lost == []
    return texts


# -- the same each time


@pytest.mark.parametrize(
    'names, count', [(['server', 'client'], 50), (['eyes'], 250), (['threads'], 400)]
)
def test_programs_say_the_same_each_time(master, names, count):
    def run():
        with Simulation(master) as simulation:
            nodes = [master.load(str(PROGRAMS / name)) for name in names]
            texts = messages_of(simulation, {'/said': STRING, '/tf': 'tf2_msgs/TFMessage'}, 15)
            for node in nodes:
                node.stop()
        return texts

    first = run()
    assert len(first) > count
    assert run() == first


def test_robot_does_the_same_each_time(master, bench):
    def run():
        with Simulation(master) as simulation, master.compose('robot', 'robot.launch'):
            topics = {'/rover/sonar/front': None, '/cmd_vel': None, '/rover/state': None}
            return messages_of(simulation, topics, 20)

    first = run()
    assert len(first) > 1000
    assert run() == first


def write_bag(path, count):
    with rosbag.Bag(str(path), 'w') as bag:
        for number in range(count):
            stamp = genpy.Time(1500000000 + number // 20, number % 20 * 50_000_000)
            scan = sensor_msgs.msg.LaserScan(ranges=[number])
            scan.header.stamp = stamp
            bag.write('/scan', scan, stamp)


def test_bag_gives_the_same_each_time(master, tmp_path):
    """A callback with queue_size=1 that takes longer than a message misses none."""
    write_bag(tmp_path / 'drive.bag', 300)

    def run():
        with Simulation(master) as simulation, master.create(BlockNode, 'ear') as ear:
            said = Mailbox(ear, '/said', STRING)
            with master.load(str(PROGRAMS / 'tracker')):
                simulation.play(str(tmp_path / 'drive.bag'))
            assert simulation.lost == []
        return [message.data for message in said.all()]

    first = run()
    tracked = [text for text in first if text[0].isdigit()]
    assert len(tracked) == 300 and tracked[-1] == '300 1500000014950000000'
    assert run() == first


def test_command_records_the_same_bytes_each_time(master, tmp_path):
    write_bag(tmp_path / 'drive.bag', 100)

    def run(*options):
        record = tmp_path / 'out.bag'
        arguments = ['--record', str(record), '--script', str(PROGRAMS / 'tracker')]
        with Program([*COMPOSE, *options, *arguments], master.url) as composed:
            assert composed.wait() == 0, composed.output
        assert 's of ROS time took' in composed.output
        return record.read_bytes()

    bag_options = '--bag', str(tmp_path / 'drive.bag'), '--topics', '/scan'
    first = run(*bag_options)
    with rosbag.Bag(str(tmp_path / 'out.bag')) as bag:
        messages = list(bag.read_messages())
    assert {topic for topic, _, _ in messages} == {'/said'}
    tracked = [(text.data, stamp) for _, text, stamp in messages if text.data[0].isdigit()]
    text, stamp = tracked[-1]
    assert text == '100 1500000004950000000'
    assert stamp.to_sec() == pytest.approx(1500000004.95, abs=1e-3)
    assert len(tracked) == 100 and run(*bag_options) == first
    assert run('--for', '20') == run('--for', '20')


def damage(path, new_path, start):
    content = path.read_bytes()
    new_path.write_bytes(content[:start] + bytes(600) + content[start + 600 :])


@pytest.mark.parametrize(
    'options, reason',
    [
        ('no.bag', 'No such file'),
        ('a.text', 'cannot be played'),
        ('gap.bag', 'a gap of 17361 days after 2.0 s'),
        ('damaged.bag', 'is damaged after 15000'),
        ('a.bag --topics nix', 'no messages'),
        ('a.bag --record a.bag', 'record to another file'),
    ],
)
def test_command_tells_of_a_bag_that_it_cannot_play(master, tmp_path, monkeypatch, options, reason):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'a.text').write_text('no bag')
    write_bag(tmp_path / 'a.bag', 9)
    write_bag(tmp_path / 'big.bag', 900)
    damage(tmp_path / 'big.bag', tmp_path / 'damaged.bag', 90_000)
    with rosbag.Bag('gap.bag', 'w') as bag:
        for second in 2, 1500000000:
            bag.write('/scan', sensor_msgs.msg.LaserScan(), genpy.Time(second))
    before = (tmp_path / 'a.bag').read_bytes()
    arguments = ['--bag', *options.split(), '--script', str(PROGRAMS / 'tracker')]
    with Program([*COMPOSE, *arguments], master.url) as composed:
        assert composed.wait() == 1
    assert reason in composed.output and 'Traceback' not in composed.output
    assert options.split()[0] in composed.output
    assert (tmp_path / 'a.bag').read_bytes() == before


def test_command_tells_of_a_full_disk(master, tmp_path):
    record = str(tmp_path / 'out.bag')
    arguments = ['--for', '9000', '--record', record, '--script', str(PROGRAMS / 'tracker')]
    limit = ['prlimit', '--fsize=900000']
    with Program([*limit, *COMPOSE, *arguments], master.url, ROS_HOME=str(tmp_path)) as composed:
        assert composed.wait() == 1
    assert f'compose: {record} cannot be written: [Errno 27]' in composed.output
    assert 'has ended' not in composed.output and 'Traceback' not in composed.output


def test_command_is_a_module_too_and_shows_its_progress(master):
    """It records as many seconds as it shall."""
    arguments = [
        '-m',
        'pharos.commands.compose',
        '--for',
        '600',
        '--script',
        str(PROGRAMS / 'threads'),
    ]
    session = pexpect.spawn(PYTHON, arguments, encoding='utf-8', timeout=TIMEOUT)
    session.expect('[0-9]+ s of ROS time\r')
    session.expect_exact('600.0 s of ROS time took')
    session.expect(pexpect.EOF)


@pytest.mark.parametrize('options', [['--for', '9'], ['--expect', 'good.bag']])
def test_prompt_refuses_options_of_a_whole_run(master, options):
    with Program(
        [*COMPOSE, '--at', '3', *options, 'robot', 'robot.launch'], master.url
    ) as composed:
        assert composed.wait() == 2
    assert '--at opens a prompt: leave out --for and --expect, or --at' in composed.output


def test_status_of_a_cut_run_is_that_of_ctrl_c(master, bench):
    say = "rospy.sleep(9)\nsay('ready')\n"
    path = bench.write(f'{INIT}{say}while not rospy.is_shutdown(): rospy.sleep(0.1)\n')
    with bench.program('--for', '1e9', '--script', path) as composed:
        bench.until(bench.said)
        composed.signal(signal.SIGINT)
        assert composed.wait() == 130
    assert 'Traceback' not in composed.output


def test_seeds_show_a_race(master):
    """If two nodes send at one time, a seed decides which of them is first."""

    def winner(seed):
        with Simulation(master) as simulation, master.create(BlockNode, 'judge') as judge:
            simulation.seed(seed)
            words = Mailbox(judge, '/word', STRING)

            def say(me):
                for _ in me.every(1):
                    me.send_to('/word', typed_as=STRING, data=me.name)

            nodes = [master.create(BlockNode, name, soul=say) for name in ('left', 'right')]
            for node in nodes:
                node.fork()
            simulation.run(5)
            for node in nodes:
                node.stop()
        return ''.join(message.data for message in words.all())

    winners = [winner(seed) for seed in range(1, 6)]
    assert len(set(winners)) > 1
    assert [winner(seed) for seed in range(1, 6)] == winners


RACES = {
    'a transform looked up too early': """
        buffer = tf2_ros.Buffer(); listener = tf2_ros.TransformListener(buffer)
        rospy.sleep(1)
        if not buffer.can_transform('map', 'robot', rospy.Time(0)): say('a bug')
        """,
    'a number read and written across a sleep': """
        def add(message):
            global count
            former = count
            time.sleep(0.001)
            count = former + 1
            calls.append(1)
            if len(calls) == 20 != count: say('a bug')
        calls, count = [], 0
        subscribers = [rospy.Subscriber(topic, String, add) for topic in ('a', 'b')]
        """,
    'a file read while another node writes it': """
        rate = rospy.Rate(10)
        while not rospy.is_shutdown():
            if os.path.exists('FILE') and not open('FILE').read(): say('a bug')
            rate.sleep()
        """,
    'the order of two publishers': """
        last = 'b'
        def hear(message):
            global last
            if last == message.data: say('a bug')
            last = message.data
        subscriber = rospy.Subscriber('word', String, hear)
        """,
}
PARTNER = """
import tf2_ros
from geometry_msgs.msg import TransformStamped
rospy.init_node('partner')
a, b, word = [rospy.Publisher(topic, String, queue_size=9) for topic in ('a', 'b', 'word')]
broadcaster = tf2_ros.TransformBroadcaster()
rospy.sleep(1)
rate = rospy.Rate(10)
while not rospy.is_shutdown():
    transform = TransformStamped(); transform.transform.rotation.w = 1
    transform.header.frame_id = 'map'; transform.child_frame_id = 'robot'
    transform.header.stamp = rospy.Time.now()
    broadcaster.sendTransform(transform)
    a.publish('a'); b.publish('b'); word.publish(rospy.get_name()[-1])
    with open('FILE', 'w') as file: time.sleep(0.001); file.write('x')
    rate.sleep()
"""


@pytest.mark.parametrize('race', RACES)
def test_seeds_find_races_and_bring_them_back(master, bench, race):
    imports = "import tf2_ros\nrospy.init_node('program')\n"
    file = str(bench.folder / 'file')
    program = bench.write(
        imports + textwrap.dedent(RACES[race]).replace('FILE', file) + 'rospy.spin()\n'
    )
    partner = bench.write(PARTNER.replace('FILE', file), 'partner')
    names = ['partner_b', 'partner_a'] if 'order' in race else ['partner_b']

    def has_bug(seed):
        with Simulation(master) as simulation:
            simulation.seed(seed)
            nodes = [master.load(partner, name=name) for name in names]
            nodes.append(master.load(program))
            simulation.run(4)
            for node in nodes:
                node.stop()
        count = len(bench.said())
        (bench.folder / 'said').unlink(missing_ok=True)
        return count

    seed = next(seed for seed in range(1, 20) if has_bug(seed))
    assert has_bug(seed)


# -- clocks, and other waits

#: expressions -> how much more they are after 3 s
CLOCKS = {
    'datetime.datetime.now()': '0:00:03.0000..',
    'datetime.datetime.utcnow()': '0:00:03.0000..',
    'time.monotonic()': '3.0000.*',
    'time.time_ns()': '30000.....',
    'time.monotonic_ns()': '30000.....',
    'time.perf_counter_ns()': '30000.....',
}
YEARS = "time.strftime('%Y'), time.localtime().tm_year, time.gmtime().tm_year, time.ctime()[-4:]"
IS_REAL = 'isinstance(datetime.datetime.now(), datetime.datetime)'
BUSY_WAIT = '''
end = rospy.get_time() + 3
while rospy.get_time() < end: pass
say(rospy.get_time() - end)'''
BUSY_LOOP = '''
while not rospy.is_shutdown():
    if woken.is_set(): break
say(time.time() - start)'''
LATER = 'rospy.Timer(rospy.Duration(3), lambda event: wake(), oneshot=True)\nstart = time.time()\n'
PIPE = "readable, writable = os.pipe()\nwake = lambda: os.write(writable, b'x')\n" + LATER
POLL = PIPE + 'poll = select.poll(); poll.register(readable)\n'
LOOP = (
    """
async def main():
    global wake
    woken = asyncio.Event()
    wake = functools.partial(asyncio.get_running_loop().call_soon_threadsafe, woken.set)
    await asyncio.wait([asyncio.ensure_future(task) for task in TASKS], return_when='FIRST_COMPLETED')
wake = None
"""
    + LATER
    + """
asyncio.run(main())
say(time.time() - start)
"""
)
#: a time, in seconds since the start
AT_1, AT_3 = '1.0000.*', '3.0000.*'
#: programs -> what they say
PROGRAM_LINES = {
    **{
        f'start = {clock}; time.sleep(3); say({clock} - start)': line
        for clock, line in CLOCKS.items()
    },
    f'say({YEARS})': '2001 2001 2001 2001',
    'time.sleep(86400); say(datetime.date.today())': '2001-09-10',
    f'say({IS_REAL}, issubclass(datetime.datetime, datetime.date))': 'True True',
    'say(pickle.loads(pickle.dumps(datetime.datetime(2020, 1, 2))))': '2020-01-02 00:00:00',
    'class Mine(datetime.datetime): pass\nsay(Mine is type(Mine.now()))': 'True',
    BUSY_WAIT: '0.000.*|.*e-05',
    BUSY_WAIT.replace('rospy.get_time', 'time.monotonic'): '0.000.*|.*e-05',
    # as loops that wait for a transform
    LATER.replace('wake()', 'woken.set()').join(
        ['woken = threading.Event()\n', BUSY_LOOP]
    ): '3.00.*',
    PIPE + 'select.select([readable], [], [], 5); say(time.time() - start)': AT_3,
    PIPE + 'select.select([readable], [], [], 1); say(time.time() - start)': AT_1,
    PIPE
    + 'while not select.select([readable], [], [], 0)[0]: pass\nsay(time.time() - start)': '3.00.*',
    POLL + 'poll.poll(5000); say(time.time() - start)': AT_3,
    POLL + 'poll.poll(1000); say(time.time() - start)': AT_1,
    LOOP.replace('TASKS', '[asyncio.sleep(1), woken.wait()]'): AT_1,
    LOOP.replace('TASKS', '[woken.wait()]'): AT_3,
    LOOP.replace('TASKS', '[asyncio.wait_for(woken.wait(), 1)]'): AT_1,
    "child = subprocess.Popen(['sleep', '0.1'])\nsay(child.poll())": '0',
    'try: os.fork()\nexcept Exception as error: say(error)': '.*use subprocess.*',
}


#: waits of 3 s by Python's and ROS's own means: programs without the line that says how long it took
WAITS_OF_PROGRAMS = {
    'a barrier': """
        def come(): time.sleep(3); barrier.wait()
        barrier = threading.Barrier(2); threading.Thread(target=come).start(); barrier.wait()
        """,
    'a semaphore': 'threading.Semaphore(0).acquire(timeout=3)',
    'a scheduler': """
        scheduler = sched.scheduler(time.time, time.sleep)
        scheduler.enter(3, 1, print); scheduler.run()
        """,
    'a queue that is joined': """
        def work(): tasks.get(); time.sleep(3); tasks.task_done()
        tasks = queue.Queue(); tasks.put(1); threading.Thread(target=work).start(); tasks.join()
        """,
    'a simple queue': """
        def put(): time.sleep(3); words.put(1)
        words = queue.SimpleQueue(); threading.Thread(target=put).start(); words.get()
        """,
    'a pool of threads': """
        with futures.ThreadPoolExecutor(3) as pool: list(pool.map(time.sleep, [1, 2, 3]))
        """,
    'the limit of a future': """
        pool = futures.ThreadPoolExecutor(1)
        try: pool.submit(time.sleep, 30).result(timeout=3)
        except futures.TimeoutError: pass
        """,
    'an executor of asyncio': """
        async def main():
            await asyncio.get_running_loop().run_in_executor(None, time.sleep, 3)
        asyncio.run(main())
        """,
    'streams of asyncio': """
        async def serve(reader, writer): await asyncio.sleep(3); writer.close()
        async def main():
            server = await asyncio.start_server(serve, '127.0.0.1', 0)
            reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            await reader.read()
        asyncio.run(main())
        """,
    'a call of a service': """
        rospy.Service('ask', Empty, lambda request: (time.sleep(3), EmptyResponse())[1])
        rospy.ServiceProxy('ask', Empty)()
        """,
    'a message that does not come': """
        try: rospy.wait_for_message('word', String, timeout=3)
        except rospy.ROSException: pass
        """,
    'a transform that does not come': """
        transforms = tf2_ros.Buffer(); listener = tf2_ros.TransformListener(transforms)
        transforms.can_transform('map', 'robot', rospy.Time(0), rospy.Duration(3))
        """,
}


@pytest.mark.parametrize('kind', WAITS_OF_PROGRAMS)
def test_wait_of_a_program_takes_virtual_time(simulation, bench, kind):
    imports = """
import asyncio, queue, sched, tf2_ros
from concurrent import futures
from std_srvs.srv import Empty, EmptyResponse
"""
    text = textwrap.dedent(WAITS_OF_PROGRAMS[kind])
    took = '\nsay(round(time.time() - start, 1))\n'
    with bench.load(f'{imports}{INIT}start = time.time()\n{text}{took}'):
        simulation.run(100)
    assert simulation.lost == []
    assert [float(line) for line in bench.said()] == [pytest.approx(3, abs=0.1)]


@pytest.mark.parametrize('program', PROGRAM_LINES)
def test_program_runs_in_virtual_time(simulation, bench, program):
    imports = "import datetime, functools, pickle, select, socket, subprocess\nrospy.init_node('program')\n"
    text = program.replace("say(", "SAY(")
    with bench.load(f'{imports}SAY = lambda *words: say(" ".join(map(str, words)))\n{text}\n'):
        simulation.run(100_000)
    assert simulation.lost == []
    (line,) = bench.said()
    assert re.fullmatch(PROGRAM_LINES[program], line), line


TALKER = """
publisher = rospy.Publisher('word', String, queue_size=10)
rospy.init_node('talker')
rate = rospy.Rate(10)
while not rospy.is_shutdown():
    publisher.publish('x')
    rate.sleep()
"""


def test_topic_from_before_init_node_is_heard_at_once(simulation, bench):
    times = []
    with simulation.master.create(BlockNode, 'ear') as ear:
        ear.interested_in('/word', STRING, lambda message: times.append(simulation.now))
        with bench.load(TALKER):
            simulation.run(2.95)
    assert len(times) == 30


UNSEEDED = (
    'uuid.uuid4()',
    'os.urandom(8)',
    'secrets.token_hex()',
    'random.random()',
    'random.Random().random()',
    '[random.seed(), random.random()]',
    'numpy.random.random()',
    'numpy.random.default_rng().random()',
    'numpy.random.RandomState().random()',
    "{'front', 'left', 'right', 'back'}",
)


def test_random_numbers_are_by_seed(master, bench):
    values = f"for value in {', '.join(UNSEEDED)}: say(value)\n"
    text = f'import numpy, random, secrets, uuid\n{values}{INIT}'
    command = [*COMPOSE, '--script', bench.write(text), '--for', '1', '--seed']

    def run(seed):
        with Program([*command, seed], master.url) as composed:
            assert composed.wait() == 0, composed.output
        lines = bench.said()
        (bench.folder / 'said').unlink()
        return lines

    first = run('7')
    assert len(first) == len(UNSEEDED) and run('7') == first
    assert not any(map(str.__eq__, run('8')[:-1], first))


def test_thread_that_waits_by_looks_lets_others_run(simulation, create_node):
    times = []

    def look(me):
        end = time.time() + 1
        while time.time() < end:
            pass

    create_node(BlockNode, soul=look).fork()
    create_node(
        BlockNode, soul=lambda me: [times.append(time.time()) for _ in me.every(0.1)]
    ).fork()
    simulation.run(1.05)
    assert len(times) == 11


def test_prompt_of_a_debugger_stops_the_time(master, bench):
    heard = "def hear(message):\n    if message.data == '5': breakpoint()\n    say(message.data)\n"
    ear = bench.write(
        f"{heard}{INIT}rospy.Subscriber('count', String, hear)\nrospy.spin()\n", 'ear'
    )
    count = "for n in range(40): pub.publish(str(n)); rospy.sleep(0.1)\n"
    pub = "rospy.init_node('mouth')\npub = rospy.Publisher('count', String, queue_size=9)\n"
    command = [*COMPOSE, '--for', '5', '--script', ear, bench.write(pub + count, 'mouth')]
    session = pexpect.spawn(command[0], command[1:], encoding='utf-8', timeout=TIMEOUT)
    session.expect_exact('(Pdb)')
    with pytest.raises(pexpect.TIMEOUT):  # longer than a thread may wait for something else
        session.expect_exact('lost', timeout=2)
    session.sendline('c')
    session.expect_exact('lost: []')
    session.expect(pexpect.EOF)
    assert bench.said() == [str(number) for number in range(40)]


# -- the prompt

STEPS = {
    'loop': 'while not rospy.is_shutdown():\n    count += 1; rospy.sleep(0.5)\n',
    'callback': 'def hear(message): global count; count += 1; word = message.data\n'
    "rospy.Subscriber('word', String, hear); rospy.spin()\n",
    'timer': 'def tick(event): global count; count += 1\n'
    'rospy.Timer(rospy.Duration(0.5), tick); rospy.spin()\n',
    'thread': 'def work():\n    global count\n    while True: time.sleep(0.5); count += 1\n'
    'threading.Thread(target=work, daemon=True).start(); rospy.spin()\n',
    'service': 'from std_srvs.srv import Empty\ndef serve(request): global count; count += 1; return []\n'
    "rospy.Service('ask', Empty, serve); rospy.spin()\n",
    'client': "from std_srvs.srv import Empty\nask = rospy.ServiceProxy('ask', Empty)\n"
    'while not rospy.is_shutdown(): rospy.sleep(0.5); ask()\n',
    # its thread starts with the only message
    'first': 'def hear(message): global count; count += 1\n'
    "rospy.Subscriber('late', String, hear); rospy.spin()\n",
    'late': "late = rospy.Publisher('late', String, queue_size=1)\n"
    "rospy.sleep(12.8); late.publish('once'); rospy.spin()\n",
    'mouth': """
class Mouth:
    def __init__(self):
        self.spoken, self.is_tired = 0, False
        self.publisher = rospy.Publisher('word', String, queue_size=1)
    def say(self, event):
        self.spoken += 1
        self.is_tired = self.spoken == 30
        self.publisher.publish(str(self.spoken))
def main():
    mouth = Mouth()
    rospy.Timer(rospy.Duration(0.5), mouth.say)
    rospy.spin()
main()
""",
}
PROMPT = r'(?:>>> |In \[\d+\]: |\(step\) )$'


class Session:
    """A session at the prompt of compose --at, as a person has it."""

    def __init__(self, seconds, *arguments, **environ):
        command = [*COMPOSE, '--at', seconds, *arguments]
        environ = {**os.environ, 'IPY_TEST_SIMPLE_PROMPT': '1', 'TERM': 'dumb', **environ}
        self.process = pexpect.spawn(
            command[0], command[1:], encoding='utf-8', timeout=TIMEOUT, env=environ, echo=False
        )
        self.process.expect(PROMPT)

    def ask(self, text):
        """Type a line, and return what is printed until the next prompt."""
        self.process.sendline(text)
        self.process.expect(PROMPT)
        return self.process.before

    def end(self):
        self.process.sendcontrol('d')
        self.process.expect(pexpect.EOF)
        self.process.close()
        return self.process.exitstatus


@pytest.fixture
def session(master, bench):
    inits = {name: f"rospy.init_node('{name}')\ncount = 0\n" for name in STEPS}
    scripts = [bench.write(inits[name] + text, name) for name, text in STEPS.items()]
    session = Session('12.3', '--script', *scripts)
    yield session
    session.process.close(force=True)


def test_prompt_goes_to_times_and_back(session):
    look = "print(now, node('/loop').count, node('mouth').spoken, node('/mouth').mouth.spoken)"
    first = session.ask(look)
    assert first.split() == ['12.3', '25', '24', '24']
    assert session.ask("topic('word').data").strip().endswith("'24'")
    assert "data: \"24\"" in session.ask("topic('/word')")
    assert 'True' in session.ask("until(lambda: node('/mouth').is_tired)")
    assert session.ask('print(now, node("/mouth").spoken)').split()[1] == '30'
    assert 'has no nix' in session.ask("until(lambda: node('/mouth').nix)")
    assert 'there is no node /nix' in session.ask("node('nix')")
    assert '/nix had no message' in session.ask("topic('nix')")
    session.ask('at(20)')
    assert session.ask(look).split()[1] == '41'
    session.ask('at(12.3)')
    assert session.ask(look) == first
    assert session.end() == 0


def test_prompt_goes_back_in_the_first_environment(master, bench):
    """A single program has the process's variables, and ROS adds its namespace to names."""
    bench.write(SPIN)
    xml = '<group ns="foo"><node pkg="bench" type="program" name="program"/></group>'
    session = Session('3', bench.launch_file(xml))
    session.ask('at(1)')
    session.ask('at(0)')
    assert 'Program' in session.ask("node('/foo/program')")
    assert session.end() == 0


@pytest.mark.parametrize('term', ['xterm', 'dumb'])
def test_ctrl_c_clears_a_line_of_the_prompt_and_stops_the_robot(master, bench, term):
    """Python's own prompt, since IPython is not there."""
    (bench.folder / 'IPython.py').write_text('raise ImportError')
    path = f'{bench.folder}:{os.environ["PYTHONPATH"]}'
    far = "    if count == 99: say('far')\n"
    loop = bench.write(f'{INIT}count = 0\n{STEPS["loop"]}{far}')
    process = Session('3', '--script', loop, TERM=term, PYTHONPATH=path).process

    def look():
        process.sendline("print('at', now, node('program').count)")
        process.expect(r'at ([0-9.]+) ([0-9]+)\r')
        return float(process.match[1]), int(process.match[2])

    for _ in range(2):
        process.send('nix')
        # Python loses a signal that comes just before it waits for a key
        while process.expect(['KeyboardInterrupt', pexpect.TIMEOUT], timeout=1):
            process.sendcontrol('c')
    assert look()[0] == 3
    process.sendline('at(1e9)')
    bench.until(bench.said)
    process.sendcontrol('c')
    now, count = look()
    assert 3 < now < 1e9
    process.sendline('at(now + 10)')
    later, more = look()
    assert later == pytest.approx(now + 10) and more == count + 20
    process.sendline('exit()')
    process.expect(pexpect.EOF)
    assert 'the end waits' not in process.before


@pytest.mark.skipif('COVERAGE_PROCESS_START' in os.environ, reason='coverage traces, too')
def test_prompt_steps_in_a_node(session):
    if sys.version_info >= (3, 14):
        assert 'write breakpoint() at the line' in session.ask("step('/loop')")
        return
    for name in ['first', 'loop', 'callback', 'timer', 'thread', 'service']:
        before = session.ask(f"print(now, node('/{name}').count)").split()
        assert f'/bench/{name}(' in session.ask(f"step('/{name}')")
        session.ask('n')
        assert re.match('[0-9]+', session.ask('p count'))
        session.ask('c')
        after = session.ask(f"print(now, node('/{name}').count)").split()
        assert float(before[0]) < float(after[0]) < float(before[0]) + 1
        assert int(after[1]) <= int(before[1]) + 2
    assert session.ask("step('/loop')")
    session.ask('q')
    assert session.ask("at(12.3); print(1)")  # the node goes on
    assert session.end() == 0


@pytest.mark.skipif('COVERAGE_PROCESS_START' in os.environ, reason='coverage traces, too')
@pytest.mark.skipif(sys.version_info >= (3, 14), reason='its debugger loses the next line')
@pytest.mark.parametrize('name, function', [('timer', 'tick'), ('loop', 'rospy.sleep')])
def test_breakpoint_of_a_step_is_reached(session, name, function):
    session.ask(f"step('/{name}')")
    assert 'Breakpoint 1' in session.ask(f'b {function}')
    for _ in range(2):
        assert f'{function.rpartition(".")[2]}(' in session.ask('c')
    session.ask('q')
    before = float(session.ask('print(now)'))
    session.ask('at(now + 5)')
    assert float(session.ask('print(now)')) == before + 5
    assert session.end() == 0


# -- in a test


class Docker(BlockNode):
    docked = False

    def start(self):
        super().start()
        self.fork(Docker.dock)

    def dock(self):
        self.sleep(500)
        self.docked = time.time()


def test_ten_minutes_go_by_at_once(simulation, create_node):
    robot = create_node(Docker)
    simulation.run(499)
    assert not robot.docked
    simulation.run(2)
    assert robot.docked


def test_time_goes_on_until_something_is_true(simulation, create_node):
    robot = create_node(Docker)
    start = simulation.now
    assert not simulation.run_until(lambda: robot.docked, 100)
    assert simulation.now - start == pytest.approx(100, abs=0.1)
    assert simulation.run_until(lambda: robot.docked, ENDLESS)
    assert simulation.now - start == pytest.approx(500, abs=0.1)


def test_robot_of_the_example_docks(simulation, create_node):
    example = runpy.run_path(str(ROOT / 'examples' / 'docking.py'))
    create_node(example['World'])
    robot = create_node(example['Robot'])
    assert simulation.run_until(lambda: robot.docked, 3600)


def test_thread_looks_at_a_clock_first_of_all(simulation):
    assert time.time() == pytest.approx(simulation.now, abs=1e-3)
    times = []
    thread = threading.Thread(target=lambda: times.append(time.time()))
    thread.start()
    thread.join()
    assert times[0] >= simulation.begin / 1e9


def test_failed_start_of_a_thread_leaves_the_time_virtual(simulation):
    """As a Ctrl-C does while a thread starts."""
    thread = threading.Thread(target=time.time)
    thread._started.set()
    with pytest.raises(RuntimeError):
        thread.start()
    assert time.time() == pytest.approx(simulation.now, abs=1e-3)


def test_time_goes_on_to_a_second_and_a_moment(simulation, create_node):
    robot = create_node(Docker)
    simulation.at(400)
    assert simulation.seconds == pytest.approx(400, abs=1e-6)
    assert simulation.run_to(lambda: robot.docked, ENDLESS)
    assert simulation.now == pytest.approx(robot.docked, abs=1e-3)
    assert not simulation.run_to(lambda: False, 1)
    create_node(BlockNode, soul=lambda me: [None for _ in me.every(0.1)]).fork()
    with pytest.raises(ZeroDivisionError):
        simulation.run_to(lambda: simulation.seconds > 510 and 1 / 0, ENDLESS)
    with pytest.raises(ValueError, match='have passed'):
        simulation.at(400)


def test_seconds_count_from_the_begin(simulation, bench):
    """The start of a program takes some time, and the program's seconds come so much later."""
    with bench.load(f'{INIT}while True: say(rospy.get_time()); rospy.sleep(1)\n'):
        start = simulation.seconds
        simulation.at(3)
        assert 0 < start < 1 and len(bench.said()) == 3
        simulation.run(start)
        assert len(bench.said()) == 4


def test_failed_test_names_the_command(simulation, bench):
    simulation.seed(7)
    with simulation.master.compose('robot', 'robot.launch', robot='red'):
        simulation.at(3)
        command = 'rosrun pharos compose --seed 7 --at 3.000 robot robot.launch robot:=red'
        assert simulation.command() == command


def test_bag_is_played_to_a_node(simulation, create_node, tmp_path):
    write_bag(tmp_path / 'drive.bag', 100)
    scans = Mailbox(create_node(BlockNode), '/scan', 'sensor_msgs/LaserScan')
    simulation.play(str(tmp_path / 'drive.bag'), topics=['/scan'])
    assert [message.ranges for message in scans.all()] == [(number,) for number in range(100)]
    assert simulation.now == pytest.approx(1500000004.95, abs=0.01)


def test_old_bag_is_played_from_now_on_and_latches(simulation, create_node, tmp_path):
    header = {'topic': '/map', 'type': STRING, 'message_definition': 'string data'}
    header.update(latching='1', md5sum=std_msgs.msg.String._md5sum)
    with rosbag.Bag(str(tmp_path / 'old.bag'), 'w') as bag:
        for second in 1, 3:
            bag.write('/word', std_msgs.msg.String(str(second)), genpy.Time(second))
        bag.write('/map', std_msgs.msg.String('big'), genpy.Time(1), connection_header=header)
    ear, times = create_node(BlockNode), []
    ear.interested_in('/word', STRING, lambda message: times.append(simulation.now))
    words = [ear.fork(lambda me: [me.sleep(1), words.append(me.wait_for_message('/map', STRING))])]
    simulation.play(str(tmp_path / 'old.bag'))
    assert words[1].data == 'big'
    assert times[1] - times[0] == pytest.approx(2, abs=0.01)


def test_parameter_of_another_node_comes_at_once(simulation, create_node):
    reader, times = create_node(BlockNode, 'reader'), []
    speed = reader.parameter('/speed', initialized=1)
    speed.on_change(lambda value: times.append(simulation.now))
    writer = create_node(BlockNode, 'writer', soul=lambda me: (me.sleep(1), other.set(2)))
    other = writer.parameter('/speed')
    start = simulation.now
    writer.fork()
    simulation.run(5)
    assert speed.value == 2 and times == [pytest.approx(start + 1, abs=0.01)]


def test_service_with_timeout_takes_virtual_time(simulation, create_node):
    arm, hand = create_node(BlockNode, 'arm'), create_node(BlockNode, 'hand')
    arm.serve('/grip', 'std_srvs/Trigger', lambda request: (arm.sleep(2) is None, ''))
    start = simulation.now
    assert hand.lookup_service('/grip').call(timeout=5).success
    assert simulation.now - start == pytest.approx(2, abs=0.01)


def test_looks_at_the_clock_take_some_time(simulation, create_node):
    """Programs divide by the time since their last look, and wait by looks alone."""
    node = create_node(BlockNode)
    for clock in time.time, time.perf_counter, node.ros.get_time:
        assert clock() < clock() < clock() + 1e-3


def test_real_time_is_back_after_the_end(master):
    clocks = time.time, time.monotonic, time.sleep
    before = time.time()
    with Simulation(master) as simulation:
        simulation.run(ENDLESS)
        assert time.time() == pytest.approx(simulation.now, abs=1e-6)
    assert (time.time, time.monotonic, time.sleep) == clocks
    assert before <= time.time() < before + ENDLESS


def test_node_goes_on_in_real_time(master):
    node = master.create(BlockNode, 'node')
    with Simulation(master):
        robot = master.create(Docker, 'robot')
    robot.stop()
    node.stop()
    assert not robot.errors


WAITS = {
    'lock': lambda lock, condition, thread: lock.acquire(timeout=5),
    'queue': lambda lock, condition, thread: queue.Queue().get(timeout=5),
    'condition': lambda lock, condition, thread: condition.wait_for(lambda: False, 5),
    'join': lambda lock, condition, thread: thread.join(5),
}


@pytest.mark.parametrize('kind', WAITS)
def test_limit_of_a_wait_is_virtual(simulation, create_node, kind):
    lock, condition = threading.Lock(), threading.Condition()
    holder = create_node(BlockNode, soul=lambda me: (lock.acquire(), me.sleep(100), lock.release()))
    thread = holder.fork()
    simulation.run(1)
    start = simulation.now
    with contextlib.suppress(queue.Empty), condition:
        WAITS[kind](lock, condition, thread)
    assert simulation.now - start == pytest.approx(5, abs=0.1)
    simulation.run(100)


# -- what takes no part


def test_thread_that_waits_for_something_else_is_named(simulation, create_node):
    readable, writable = os.pipe()
    simulation.allow_waits()
    node = create_node(BlockNode, soul=lambda me: os.read(readable, 1))
    thread = node.fork(name='reader')
    simulation.run(1)
    assert simulation.lost == ['reader']
    os.write(writable, b'x')
    thread.join(TIMEOUT)
    os.close(readable)
    os.close(writable)


DEADLOCK = """
def take(first, second):
    with first:
        time.sleep(0.1)
        with second: pass  # this line
locks = threading.RLock(), threading.Lock()
for pair in locks, locks[::-1]:
    threading.Thread(target=take, args=pair).start()
"""
SELF_LOCK = 'def take():\n    lock.acquire()\n    lock.acquire()  # this line\n'
LEFT_LOCK = 'def take(): lock.acquire()\ntake()\ntime.sleep(0.1); lock.acquire()  # this line\n'
LOCKS = {
    DEADLOCK: 2,
    SELF_LOCK + 'lock = threading.Lock(); threading.Thread(target=take).start()\n': 1,
    'condition, event = threading.Condition(), threading.Event()\n'
    'def wait():\n    with condition: condition.wait()\n'
    'for block in wait, event.wait: threading.Thread(target=block).start()\n': 0,
}


@pytest.mark.parametrize('text', LOCKS)
def test_deadlock_is_named(master, bench, text):
    path = bench.write(INIT + text)
    line = pathlib.Path(path).read_text().partition('# this line')[0].count('\n') + 1
    with Program([*COMPOSE, '--for', '1', '--script', path], master.url) as composed:
        assert composed.wait() == int(LOCKS[text] > 0)
    assert composed.output.count(f'{path}:{line}') == LOCKS[text]
    assert composed.output.count('for ever') == LOCKS[text]


def test_deadlock_with_the_test_is_named(simulation, create_node):
    """Nobody has a turn any more."""
    locks = threading.Lock(), threading.Lock()

    def take(me):
        with locks[0]:
            me.sleep(1)
            locks[1].acquire()

    create_node(BlockNode, soul=take).fork()
    with locks[1]:
        simulation.run(2)
        with pytest.raises(PharosError, match='(?s)for ever.*test_simulation.*test_simulation'):
            locks[0].acquire()
    assert simulation.deadlocks() == []


def test_child_that_takes_long_is_named(simulation, bench):
    simulation.allow_waits()
    text = (
        "import subprocess\nchild = subprocess.Popen(['sleep', '9'])\nchild.poll()\nchild.kill()\n"
    )
    with bench.load(INIT + text):
        simulation.run(1)
    assert "['sleep', '9']" in simulation.lost[0]


def test_program_of_another_process_is_refused(simulation, bench):
    with pytest.raises(PharosError, match='/rover/avoider: has a process of its own'):
        simulation.master.compose('robot', 'robot.launch', apart=['avoider'])


# -- two recordings

DRIVER = '''#!/usr/bin/python3
import rospy
from geometry_msgs.msg import Twist
rospy.init_node('driver')
commands = rospy.Publisher('/cmd_vel', Twist, queue_size=10)
rate, speed = rospy.Rate(10), 0.0
while not rospy.is_shutdown():
    speed += rospy.get_param('~gain', 0.5) * (1 - speed)
    message = Twist()
    message.linear.x = speed
    commands.publish(message)
    rate.sleep()
'''


def bag_of(path, *rows):
    """Write messages (topic, message, seconds) to a bag, and return its path."""
    with rosbag.Bag(str(path), 'w') as bag:
        for topic, message, seconds in rows:
            bag.write(topic, message, genpy.Time.from_sec(seconds))
    return str(path)


def numbers(*values, topic='/n', begin=10.0):
    return [
        (topic, std_msgs.msg.Float64(value), begin + number / 2)
        for number, value in enumerate(values)
    ]


def layout(*labels):
    dimensions = [std_msgs.msg.MultiArrayDimension(label=label) for label in labels]
    return std_msgs.msg.MultiArrayLayout(dim=dimensions)


NAN = float('nan')
GOOD = numbers(1.0, 2.0, NAN)
FIELDS = sensor_msgs.msg.Imu(orientation_covariance=[0.0] * 9)
JOINTS = sensor_msgs.msg.JointState(name=['a', 'b'])
OTHER_FIELDS = sensor_msgs.msg.Imu(orientation_covariance=[0.0] * 5 + [0.1] + [0.0] * 3)


@pytest.mark.parametrize(
    'expected, actual, lines',
    [
        (GOOD, GOOD, []),
        (GOOD, numbers(1.0, 2.0001, NAN), ['0.500 s /n #1 data: 2.0 -> 2.0001']),
        (GOOD, numbers(1.0, 2.0), ['1.000 s /n #2 is missing, with all after it']),
        (numbers(1.0, 2.0), GOOD, ['1.000 s /n #2 is additional']),
        (
            numbers(*range(9)),
            numbers(*range(9))[:3] + numbers(*range(9))[4:],
            ['1.500 s /n #3 is missing'],
        ),
        (
            numbers(*range(9))[:3] + numbers(*range(9))[4:],
            numbers(*range(9)),
            ['2.000 s /n #3 is additional'],
        ),
        (GOOD, numbers(1.0, 2.0, NAN, begin=10.01), ['0.000 s /n #0 came 0.010000 s later']),
        (
            GOOD,
            numbers(1.0, 2.0, NAN, topic='/m'),
            ['0.000 s /m #0 is additional', '0.000 s /n #0 is missing, with all after it'],
        ),
        (
            [('/i', FIELDS, 10.0), *numbers(1.0, begin=9.5)],
            [('/i', OTHER_FIELDS, 10.0), *numbers(1.5, begin=9.5)],
            [
                '-0.500 s /n #0 data: 1.0 -> 1.5',
                '0.000 s /i #0 orientation_covariance[5]: 0.0 -> 0.1',
            ],
        ),
        (
            GOOD[:1],
            [('/n', std_msgs.msg.String('1'), 10.0)],
            ['0.000 s /n #0 type: std_msgs/Float64 -> std_msgs/String'],
        ),
        (
            [('/j', JOINTS, 10.0)],
            [('/j', sensor_msgs.msg.JointState(name=['b']), 10.0)],
            ["0.000 s /j #0 name: ['a', 'b'] -> ['b']"],
        ),
        (
            [('/l', layout('height', 'width'), 10.0)],
            [('/l', layout('height', 'depth'), 10.0)],
            ['0.000 s /l #0 dim[1].label: width -> depth'],
        ),
    ],
)
def test_recordings_differ_by_the_first_field(tmp_path, expected, actual, lines):
    paths = bag_of(tmp_path / 'good.bag', *expected), bag_of(tmp_path / 'new.bag', *actual)
    assert differences(*paths, 10.0) == lines


def test_tolerance_lets_numbers_differ(tmp_path):
    old = bag_of(tmp_path / 'good.bag', *GOOD)
    new = bag_of(tmp_path / 'new.bag', *numbers(1.0, 2.0001, NAN))
    assert differences(old, new, 10.0, 1e-3) == []
    assert differences(old, new, 10.0, 1e-5) != []


def test_tolerance_lets_times_differ(tmp_path):
    clock = std_msgs.msg.Time
    old = bag_of(tmp_path / 'a.bag', ('/t', clock(genpy.Time(5)), 10.0))
    new = bag_of(tmp_path / 'b.bag', ('/t', clock(genpy.Time(5, 10**7)), 10.01))
    assert differences(old, new, 10.0, 0.02) == []
    assert differences(old, new, 10.0, 0.005) == ['0.000 s /t #0 data: 5000000000 -> 5010000000']


def test_difference_of_long_values_is_shown(tmp_path):
    texts = [f'{"x" * 500}{end}' for end in ('old', 'new')]
    paths = [
        bag_of(tmp_path / f'{number}.bag', ('/p', std_msgs.msg.String(text), 10.0))
        for number, text in enumerate(texts)
    ]
    (line,) = differences(*paths, 10.0)
    assert re.fullmatch(r'0.000 s /p #0 data: \.\.\.x{30}old -> \.\.\.x{30}new', line)


def test_what_comes_after_the_end_is_told_in_one_line(tmp_path):
    old = bag_of(tmp_path / 'good.bag', *numbers(*range(9)), ('/m', std_msgs.msg.Empty(), 14.0))
    new = bag_of(tmp_path / 'new.bag', *numbers(*range(4)))
    assert differences(old, new, 10.0, 0.0, 1.5) == [
        f'1.500 s the run has ended; {old} goes on: compare runs as long'
    ]
    assert '/n #4 is missing' in differences(old, new, 10.0, 0.0, 2.0)[0]


def test_recording_of_a_latched_topic_is_latched(simulation, create_node, tmp_path):
    bag = str(tmp_path / 'map.bag')
    driver = create_node(BlockNode, 'driver')
    simulation.record_to(bag)
    driver.output_channel('/map', STRING, latch=True).send(data='x')
    driver.send_to('/speed', typed_as=STRING, data='y')
    simulation.run(1)
    simulation.close_record()
    with rosbag.Bag(bag) as file:
        headers = {
            item.topic: item.connection_header
            for item in file.read_messages(return_connection_header=True)
        }
    assert headers['/map']['latching'] == b'1' and headers['/map']['callerid'] == b'/driver'
    assert headers['/speed'].get('latching', b'0') == b'0'


def test_difference_is_told_in_one_line(tmp_path):
    path = std_msgs.msg.MultiArrayLayout
    old = bag_of(tmp_path / 'a.bag', ('/p', path(dim=[]), 10.0))
    new = bag_of(tmp_path / 'b.bag', ('/p', path(dim=[std_msgs.msg.MultiArrayDimension()]), 10.0))
    (line,) = differences(old, new, 10.0)
    assert line.startswith("0.000 s /p #0 dim: [] -> [label: '' size: 0"), line


def test_command_compares_with_a_recording(master, tmp_path):
    driver = tmp_path / 'driver'
    driver.write_text(DRIVER)

    def run(*arguments):
        command = [*COMPOSE, '--for', '5', *arguments, '--script', str(driver)]
        with Program(command, master.url, ROS_HOME=str(tmp_path)) as composed:
            return composed.wait(), composed.output

    good = str(tmp_path / 'good.bag')
    status, output = run('--expect', good)
    assert status == 1 and f'there is no {good}: make it by --record {good}' in output
    assert run('--record', good)[0] == 0
    status, output = run('--expect', good)
    assert status == 0
    assert re.search(rf'^as {re.escape(good)}: [1-9]\d* messages of 1 topics$', output, re.M)
    driver.write_text(f'# equal\n{DRIVER}'.replace('message', 'command'))
    assert run('--expect', good)[0] == 0
    driver.write_text(DRIVER.replace('0.5', '0.50005'))
    status, output = run('--expect', good)
    assert status == 1
    assert re.search(r'^0\.\d{3} s /cmd_vel #0 linear\.x: 0\.5 -> 0\.50005$', output, re.M)
    assert 'none by --tolerance 0.01' in output
    driver.write_text(DRIVER.replace('= speed', '= speed + 1e-5 + (speed > 0.99)'))
    text = r'^the first by --tolerance 0\.01: 0\.\d{3} s /cmd_vel #6 linear\.x: 0\.992\d* -> 1\.992\d*$'
    assert re.search(text, run('--expect', good)[1], re.M)
    driver.write_text(DRIVER.replace('0.5', '0.50005'))
    assert run('--expect', good, '--tolerance', '1e-3')[0] == 0


def test_simulation_expects_a_recording(simulation, create_node, tmp_path):
    bag, mouth = str(tmp_path / 'good.bag'), create_node(BlockNode, 'mouth')

    def say(text):
        simulation.nanoseconds = simulation.begin
        with simulation.expect(bag):
            mouth.send_to('/words', typed_as=STRING, data=text)

    with pytest.raises(AssertionError, match='it is recorded now'):
        say('hello')
    say('hello')
    with pytest.raises(AssertionError, match=r's /words #0 data: hello -> hallo'):
        say('hallo')
