"""Real peers, both ways: rospy, roscpp, ROS's own programs, and the libraries written on rospy."""
import contextlib
import os
import signal
import subprocess
import threading
import xmlrpc.client

import actionlib.msg
import genpy
import pytest
import rosbag
import std_msgs.msg
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped, TransformStamped

import helpers
from helpers import INIT, TIMEOUT, Gate, Peer, Program, create
import pharos
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'
IMAGE = 'sensor_msgs/Image'
RELAY = '/usr/lib/topic_tools/relay'
NODELET = '/usr/lib/nodelet/nodelet'
MEGABYTES = 6 << 20
TWO_FIELDS = 'int32 number\nstring[] words\n'

needs_relay = pytest.mark.skipif(not os.path.exists(RELAY), reason='needs topic-tools')
needs_nodelet = pytest.mark.skipif(not os.path.exists(NODELET), reason='needs libnodeletlib-tools')


PEER = 'import threading, genpy.dynamic, std_msgs.msg, std_srvs.srv'
network, master, peer = helpers.network, helpers.network_master, helpers.network_peer


@pytest.fixture
def node(master):
    return create(master)


def ros(*command, **options):
    """Run a program to its end; returns what it printed."""
    options = {'text': True, 'capture_output': True, 'timeout': 2 * TIMEOUT, **options}
    ended = subprocess.run(command, **options)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@contextlib.contextmanager
def running(master, *command):
    """A program that is ended as by Ctrl-C, so that it unregisters."""
    with Program(command, master.url) as program:
        try:
            yield program
        finally:
            program.signal(signal.SIGINT)
            program.wait()


# -- rospy


def test_rospy_hears_what_pharos_sends(peer, node):
    peer.hear('/hears', STRING)
    for number in range(20):
        node.send_to('/hears', typed_as=STRING, data=str(number))
    heard = peer.heard('/hears', 20)
    assert [message.data for message in heard] == [str(number) for number in range(20)]


@pytest.mark.filterwarnings('ignore:The publisher should be created:SyntaxWarning')
def test_publisher_of_plain_rospy_needs_no_queue_size(peer, node):
    peer.hear('/plain', STRING)
    publisher = node.ros.Publisher('/plain', std_msgs.msg.String)
    until(publisher.get_num_connections, TIMEOUT)
    for text in 'a', 'b':
        publisher.publish(text)
    assert [message.data for message in peer.heard('/plain', 2)] == ['a', 'b']


def test_pharos_hears_what_rospy_sends(peer, node):
    box = Mailbox(node, '/sends', STRING)
    peer.run("sends = rospy.Publisher('/sends', std_msgs.msg.String, queue_size=100)")
    until(lambda: peer.value('sends.get_num_connections()'), TIMEOUT)
    peer.run('for number in range(20): sends.publish(str(number))')
    assert [box.next().data for _ in range(20)] == [str(number) for number in range(20)]
    assert box.channel.connections == [('/peer', 'TCPROS')]


def test_pharos_gets_latched_message_of_rospy(peer, node):
    peer.run(
        "latched = rospy.Publisher('/latched', std_msgs.msg.String, queue_size=1, latch=True)\n"
        "latched.publish('kept')"
    )
    assert Mailbox(node, '/latched').next().data == 'kept'  # typed as the master says


def test_what_a_peer_gets_is_counted(peer, node):
    """As getBusStats has it, which rosnode and roscpp's tools show."""
    channel = node.output_channel('/words', STRING, queue_size=10)
    peer.hear('/words', STRING)
    until(lambda: channel.connections)

    def traffic():
        topics, _, _ = xmlrpc.client.ServerProxy(node.uri).getBusStats('/me')[2]
        ((data_size, rows),) = [each[1:] for each in topics if each[0] == '/words']
        ((_, size, number, _),) = rows
        return data_size, size, number

    data_size, size, number = traffic()
    assert data_size == number == 0  # the size is that of the handshake
    for _ in range(3):
        channel.send(data='word')
    until(lambda: traffic() == (36, size + 36, 3))  # each has two lengths of 4 bytes


def test_later_channel_knows_who_latched_the_message(peer, node):
    """By the connection header, as in rospy."""
    peer.run("out = rospy.Publisher('/words', std_msgs.msg.String, queue_size=1, latch=True)")
    peer.run("out.publish('x')")
    assert Mailbox(node, '/words', STRING).next().data == 'x'
    later = Mailbox()
    node.interested_in('/words', STRING, later, from_='/peer')
    assert later.next()._connection_header['callerid'] == '/peer'


def test_rospy_gets_latched_message_of_pharos(peer, node):
    node.output_channel('/kept', STRING, latch=True).send(data='kept')
    assert peer.value(f"rospy.wait_for_message('/kept', std_msgs.msg.String, {TIMEOUT})").data == (
        'kept'
    )


def test_rospy_calls_service_of_pharos(peer, node):
    node.serve('/enable', 'std_srvs/SetBool', lambda request: (request.data, 'thanks'))
    peer.run("proxy = rospy.ServiceProxy('/enable', std_srvs.srv.SetBool, persistent=True)")
    assert [peer.value(f'proxy({data}).success') for data in (True, False)] == [True, False]


def test_pharos_calls_service_of_rospy(peer, node):
    peer.run(
        "service = rospy.Service('/add', std_srvs.srv.SetBool,"
        " lambda request: (not request.data, 'turned'))"
    )
    answer = node.wait_for_service('/add', TIMEOUT).call(data=True)
    assert (answer.success, answer.message) == (False, 'turned')


def test_failing_service_tells_rospy(peer, node):
    node.serve('/fails', 'std_srvs/Empty', lambda request: 1 / 0)
    with pytest.raises(RuntimeError, match='ServiceException'):
        peer.run("rospy.ServiceProxy('/fails', std_srvs.srv.Empty)()")


def test_failing_rospy_service_raises_here(peer, node):
    peer.run("failing = rospy.Service('/refuses', std_srvs.srv.Empty, lambda request: 1 / 0)")
    with pytest.raises(pharos.ServiceCallError):
        node.wait_for_service('/refuses', TIMEOUT).call()


def test_rospy_reads_log_under_nodes_name(peer, node):
    peer.hear('/rosout', 'rosgraph_msgs/Log')
    names = "[line.name for line in heard['/rosout'] if line.msg == 'here I am']"
    until(lambda: node.log('here I am') or peer.value(names), TIMEOUT)
    assert set(peer.value(names)) == {'/node'}


def test_other_type_is_not_delivered(peer, node):
    box, marker = Mailbox(node, '/typed', STRING), Mailbox(node, '/marker', 'std_msgs/Int32')
    peer.run(
        'others = [rospy.Publisher(topic, std_msgs.msg.Int32, queue_size=1, latch=True)\n'
        "    for topic in ('/typed', '/marker')]\n"
        'for each in others: each.publish(5)'
    )
    assert marker.next().data == 5
    create(node.master, '/second').send_to('/typed', typed_as=STRING, data='fits')
    assert box.next().data == 'fits' == box.all()[0].data


# -- connections that nodes share


@pytest.fixture
def ears(master):
    """Three nodes that share connections."""
    sharing = pharos.Master(master.url, share_connections=True)
    return [create(sharing, f'/ear{number}') for number in range(3)]


def publish(peer, topic, *texts, latch=False, type_=STRING):
    """Have a peer make its publisher ``out``, and publish texts."""
    peer.run(
        f'out = rospy.Publisher({topic!r}, message_class({type_!r}), queue_size=1000, latch={latch})'
    )
    for text in texts:
        peer.run(f'out.publish({text!r})')


def count(peer):
    """The connections of the peer's publisher."""
    return peer.value('out.get_num_connections()')


def hear(peer, nodes, topic, type_=STRING, **options):
    """Return a Mailbox of each node, when all of them are connected to the peer."""
    boxes = [Mailbox() for _ in nodes]
    for node, box in zip(nodes, boxes):
        box.channel = node.interested_in(topic, type_, box, **options)
    connected = [(peer.name, 'TCPROS')]
    until(lambda: all(box.channel.connections == connected for box in boxes))
    until(lambda: count(peer))
    return boxes


def texts_of(box, last):
    """Wait for a text, and return all that came."""
    until(lambda: last in [message.data for message in box.all()], TIMEOUT, last)
    return [message.data for message in box.all()]


def test_nodes_share_one_connection(peer, ears):
    publish(peer, '/shared/one')
    boxes = hear(peer, ears, '/shared/one')
    assert count(peer) == 1
    for number in range(20):
        peer.run(f"out.publish('{number}')")
    for box in boxes:
        assert texts_of(box, '19') == [str(number) for number in range(20)]
        assert box.channel.received == 20


def test_nodes_have_own_connections_by_default(master, peer):
    publish(peer, '/shared/not')
    hear(peer, [create(master, f'/ear{number}') for number in range(3)], '/shared/not')
    until(lambda: count(peer) == 3)


def test_message_of_a_shared_connection_is_its_nodes_own(peer, ears):
    publish(peer, '/shared/status', type_='diagnostic_msgs/DiagnosticStatus')
    seen = []

    def change(message):
        seen.append((message.name, [value.key for value in message.values]))
        message.name = 'changed'
        message.values[0].key = 'changed'
        message.values.append(None)

    for ear in ears:
        ear.interested_in('/shared/status', 'diagnostic_msgs/DiagnosticStatus', change)
        ear.ros.Subscriber('/shared/status', DiagnosticStatus, change)
    until(lambda: all(channel.connections for ear in ears for channel in ear.channels))
    until(lambda: count(peer))
    peer.run('import diagnostic_msgs.msg as diagnostics')
    peer.run("values = [diagnostics.KeyValue('key', 'value')]")
    peer.run("out.publish(diagnostics.DiagnosticStatus(name='motor', values=values))")
    until(lambda: len(seen) == 6)
    assert seen == [('motor', ['key'])] * 6


def test_shared_channels_get_one_object(peer, ears):
    publish(peer, '/shared/object')
    owns = hear(peer, ears[:1], '/shared/object')
    boxes = hear(peer, ears, '/shared/object', shared=True)
    owns += hear(peer, ears[2:], '/shared/object')
    peer.run("out.publish('x')")
    first, second, third = [box.next() for box in boxes]
    assert first is second is third
    one, other = [box.next() for box in owns]
    assert one == other == first
    assert len({id(one), id(other), id(first)}) == 3


def test_shared_connection_names_its_publisher(peer, ears):
    publish(peer, '/shared/names')
    boxes = hear(peer, ears, '/shared/names', from_=peer.name)
    others = hear(peer, ears, '/shared/names', from_='/somebody')
    peer.run("out.publish('x')")
    for box in boxes:
        assert box.next()._connection_header['callerid'] == peer.name
    assert not any(box.all() or box.channel.received for box in others)


def test_late_node_of_a_shared_connection_gets_the_latched_message(peer, ears):
    """As it was published, whatever the earlier nodes have done to their own."""
    publish(peer, '/shared/map', 'old', 'map', latch=True)
    texts = {ear: [] for ear in ears}

    def change(message, channel):
        texts[channel.node].append(message.data)
        message.data = 'changed'

    for ear in ears:
        ear.interested_in('/shared/map', STRING, change)
        until(lambda ear=ear: texts[ear] == ['map'])
    assert count(peer) == 1
    peer.run("out.publish('end')")
    until(lambda: list(texts.values()) == [['map', 'end']] * 3)


PACE = '''
import time
def pace():
    for number in range(400):
        out.publish(str(number))
        time.sleep(0.003)
pacer = threading.Thread(target=pace)
pacer.start()
'''


@pytest.mark.parametrize('latch', [False, True])
@pytest.mark.parametrize('end', ['stop', 'close'])
def test_node_that_leaves_takes_no_message_from_others(master, peer, ears, end, latch):
    """The node whose connection it was, too; nor does a node that comes meanwhile."""
    topic = f'/shared/{end}_{latch}'
    publish(peer, topic, latch=latch)
    boxes = hear(peer, ears, topic)
    peer.run(PACE)
    lates = []
    for number, (ear, box) in enumerate(zip(ears[:2], boxes)):
        texts_of(box, str(100 * number + 50))
        ear.stop() if end == 'stop' else box.channel.close()
        late = Mailbox(create(boxes[2].channel.node.master, f'/late{number}'), topic, STRING)
        lates.append(late)
    assert texts_of(boxes[2], '399') == [str(number) for number in range(400)]
    assert count(peer) == 1
    for box in lates:
        texts = texts_of(box, '399')
        assert texts == [str(number) for number in range(int(texts[0]), 400)]
    for box in boxes[:2]:
        assert [message.data for message in box.all()] == [str(n) for n in range(len(box.all()))]
    for channel in [boxes[2].channel, *[box.channel for box in lates]]:
        channel.close()
    until(lambda: not count(peer))


FLOW = """
def flow():
    number = 0
    while not is_over.is_set():
        out.publish(str(number))
        number += 1
is_over = threading.Event()
flowing = threading.Thread(target=flow)
flowing.start()
"""


def test_nodes_come_and_go_while_messages_flow(master, peer, ears):
    """Each hears the latched message, and then all others, one after another."""
    publish(peer, '/shared/flow', latch=True)
    peer.run('out.impl.queue_size = None')  # the publisher waits for the socket
    hear(peer, ears[:1], '/shared/flow', queue_size=0)
    peer.run(FLOW)
    try:
        for _ in range(10):
            boxes = []
            for ear in ears[1:]:
                boxes.append(Mailbox())
                ear.interested_in('/shared/flow', STRING, boxes[-1], queue_size=0)
            for box, ear in zip(boxes, ears[1:]):
                until(lambda box=box: len(box.all()) > 100)
                ear.channels[0].close()
                numbers = [int(message.data) for message in box.all()]
                assert numbers == [*range(numbers[0], numbers[0] + len(numbers))]
    finally:
        peer.run('is_over.set(); flowing.join()')


def test_each_publisher_has_a_shared_connection(master, peer, ears):
    publish(peer, '/shared/two', 'of the first', latch=True)
    with Peer(master.url, 'second') as second:
        publish(second, '/shared/two', 'of the second', latch=True)
        boxes = [Mailbox(ear, '/shared/two', STRING) for ear in ears]
        for box in boxes:
            texts = sorted(box.next().data for _ in range(2))
            assert texts == ['of the first', 'of the second']
        assert count(peer) == count(second) == 1
        second.run("out.publish('end')")
        for box in boxes:
            assert len(texts_of(box, 'end')) == 3


def lose_socket(camera):
    """The publisher stays registered."""
    camera.run('for connection in list(out.impl.connections): connection.close()')


def advertise_again(camera):
    camera.run('out.unregister()')
    publish(camera, '/shared/film')


@pytest.mark.parametrize('lose', [lose_socket, advertise_again, Peer.end])
def test_publisher_that_comes_back_is_heard_by_all(master, ears, lose):
    with contextlib.ExitStack() as stack:
        camera = stack.enter_context(Peer(master.url, 'camera'))
        publish(camera, '/shared/film')
        boxes = hear(camera, ears, '/shared/film')
        lose(camera)
        if lose is Peer.end:
            camera = stack.enter_context(Peer(master.url, 'camera'))
            publish(camera, '/shared/film')
        until(lambda: camera.run("out.publish('again')") or all(box.all() for box in boxes))
        assert count(camera) == 1
        camera.run("out.publish('end')")
        for box in boxes:
            assert texts_of(box, 'end').count('end') == 1


BLOCKING = {
    'delegate': lambda node, topic, gate: node.interested_in(topic, STRING, gate),
    'callback': lambda node, topic, gate: node.ros.Subscriber(topic, std_msgs.msg.String, gate),
    'callback with queue': lambda node, topic, gate: node.ros.Subscriber(
        topic, std_msgs.msg.String, gate, queue_size=100
    ),
}


@pytest.mark.parametrize('kind', BLOCKING)
def test_blocking_callback_holds_up_no_other_node(peer, ears, kind):
    topic = '/shared/' + kind.replace(' ', '_')
    publish(peer, topic)
    gate = Gate()
    BLOCKING[kind](ears[0], topic, gate)
    boxes = hear(peer, ears[1:], topic)
    until(lambda: peer.run("out.publish('begin')") or gate.begun.is_set())
    for number in range(20):
        peer.run(f"out.publish('{number}')")
    for box in boxes:
        assert texts_of(box, '19')[-20:] == [str(number) for number in range(20)]
    assert count(peer) == 1
    gate.open.set()
    until(lambda: gate.heard[-20:] == [str(number) for number in range(20)])


def test_other_class_has_a_connection_of_its_own(peer, ears):
    publish(peer, '/shared/any')
    raw = Mailbox()
    boxes = hear(peer, ears[:2], '/shared/any')
    ears[2].ros.Subscriber('/shared/any', ears[2].ros.AnyMsg, raw)
    until(lambda: count(peer) == 2)
    peer.run("out.publish('x')")
    assert raw.next()._buff[-1:] == b'x'
    assert [box.next().data for box in boxes] == ['x', 'x']


@pytest.mark.parametrize('options, number', [([], 1), (['--own-connections'], 3)])
def test_composed_programs_share_connections(bench, peer, options, number):
    topic = f'/shared/composed_{number}'
    publish(peer, topic, 'x', latch=True)
    text = f"{INIT}rospy.Subscriber('{topic}', String, lambda m: say('heard'))\nrospy.spin()\n"
    path = bench.launch_file(one=text, two=text, three=text)
    with bench.program(path, *options):
        until(lambda: bench.said() == ['heard'] * 3)
        assert count(peer) == number


# -- types that are known to the other side alone


def test_unknown_type_comes_by_its_definition(peer, node):
    peer.run(
        f"own = genpy.dynamic.generate_dynamic('odd_msgs/Odd', {TWO_FIELDS!r})['odd_msgs/Odd']\n"
        "odd = rospy.Publisher('/odd', own, queue_size=1, latch=True)\n"
        "odd.publish(7, ['a', 'b'])"
    )
    message = Mailbox(node, '/odd').next()
    assert (message._type, message.number, message.words) == ('odd_msgs/Odd', 7, ['a', 'b'])


def test_defined_type_is_understood_by_rospy(peer, node):
    pharos.define_message('even_msgs/Even', TWO_FIELDS)
    peer.run(
        f"own = genpy.dynamic.generate_dynamic('even_msgs/Even', {TWO_FIELDS!r})\n"
        'evens, came = [], threading.Event()\n'
        'def keep_even(message): evens.append((message.number, message.words)); came.set()\n'
        "even = rospy.Subscriber('/even', own['even_msgs/Even'], keep_even)"
    )
    node.send_to('/even', typed_as='even_msgs/Even', number=8, words=['c'])
    assert peer.value(f'came.wait({TIMEOUT}) and evens') == [(8, ['c'])]


# -- large messages


def test_large_message_reaches_rospy(peer, node):
    data = os.urandom(MEGABYTES)
    peer.hear('/large', IMAGE)
    node.send_to('/large', typed_as=IMAGE, height=1, data=data)
    assert (bytes(peer.heard('/large')[0].data) == data) is True  # no difference of 6 MB is shown


def test_large_message_comes_from_rospy(peer, node):
    peer.run(
        f"image = message_class({IMAGE!r})(height=2, data=bytes(range(256)) * {MEGABYTES // 256})\n"
        "camera = rospy.Publisher('/camera', type(image), queue_size=1, latch=True)\n"
        'camera.publish(image)'
    )
    data = Mailbox(node, '/camera', IMAGE).next().data
    assert (bytes(data) == bytes(range(256)) * (MEGABYTES // 256)) is True


# -- rostopic, rosservice, rosnode, rosparam


@pytest.fixture
def robot(node):
    """A node with a topic, a service and a parameter, for ROS's programs to look at."""
    node.output_channel('/shown', STRING, latch=True).send(data='seen')
    node.interested_in('/wanted', 'std_msgs/Int32')
    node.serve('/greet', 'std_srvs/Trigger', lambda request: (True, 'hello'))
    node.parameter('~speed', initialized=1.5)
    return node


@pytest.mark.parametrize(
    'command, said',
    [
        ('rostopic list', ['/shown', '/wanted']),
        ('rostopic list -v', ['* /shown [std_msgs/String] 1 publisher']),
        ('rostopic type /shown', ['std_msgs/String']),
        ('rostopic info /wanted', ['Type: std_msgs/Int32', '* /node (']),
        ('rostopic echo -n 1 /shown', ['data: "seen"']),
        ('rosservice list', ['/greet']),
        ('rosservice type /greet', ['std_srvs/Trigger']),
        ('rosservice info /greet', ['Node: /node', 'Type: std_srvs/Trigger', 'URI: rosrpc://']),
        ('rosservice call /greet', ['success: True', 'message: "hello"']),
        ('rosnode list', ['/node']),
        ('rosnode info /node', ['* /shown [std_msgs/String]', '* /wanted [', '* /greet', 'Pid: ']),
        ('rosnode ping -c 1 /node', ['xmlrpc reply from']),
        ('rosparam get /node/speed', ['1.5']),
        ('rosparam list', ['/node/speed']),
    ],
)
def test_program_of_ros_understands_node(robot, command, said):
    output = ros(*command.split())
    assert [text for text in said if text not in output] == [], output


def test_rosnode_info_shows_pid_and_links(robot):
    create(robot.master, '/hearer').interested_in('/shown', STRING)
    output = ros('rosnode', 'info', '/hearer')
    assert f'Pid: {os.getpid()}\n' in output
    assert '* topic: /shown\n    * to: /node' in output


def test_rostopic_pub_reaches_waiting_node(master, node):
    box = Mailbox(node, '/published', STRING)
    with running(master, 'rostopic', 'pub', '/published', STRING, 'data: from outside'):
        assert box.next().data == 'from outside'


def test_rostopic_hz_measures_node(master, node):
    channel = node.output_channel('/rated', STRING)
    node.fork(lambda me: [channel.send(data='x') for _ in me.every(0.01)])
    with running(master, 'rostopic', 'hz', '/rated') as program:
        program.expect('average rate: ')


def test_rosparam_set_runs_on_change(node):
    parameter, changed = node.parameter('~limit', initialized=1), threading.Event()
    parameter.on_change(lambda value: changed.set())
    ros('rosparam', 'set', '/node/limit', '5')
    assert changed.wait(TIMEOUT)
    assert parameter.value == 5


def test_rosnode_kill_stops_one_node(master, node):
    other = create(master, '/other')
    assert 'killed' in ros('rosnode', 'kill', '/node')
    until(lambda: not node.is_running, TIMEOUT)
    assert other.is_running


def test_rosnode_cleanup_removes_dead_alone(master, node):
    node.output_channel('/living', STRING)
    with Peer(master.url, name='dead') as dead:
        dead.end()
    assert '* /dead' in ros('rosnode', 'cleanup', input='y\n')
    assert master.topic('/living').publishers == ['/node']
    assert '/dead' not in [found.name for found in master.nodes()]


def test_roswtf_finds_no_fault(robot, tmp_path):
    online = ros('roswtf', cwd=tmp_path).split('Online checks summary:')[1]
    assert 'ERROR' not in online, online


# -- rosbag


def test_rosbag_records_what_pharos_sends(master, node, tmp_path):
    path = tmp_path / 'said.bag'
    channels = [node.output_channel(f'/bag_{side}', STRING) for side in 'ab']
    command = 'rosbag', 'record', '--limit=10', '-O', str(path), '/bag_a', '/bag_b'
    with Program(command, master.url) as program:
        for channel in channels:
            assert channel.wait_for_subscribers(1, TIMEOUT)
        for number in range(10):
            for channel in channels:
                channel.send(data=f'{channel.topic} {number}')
        assert program.wait() == 0, program.output
    with rosbag.Bag(str(path)) as bag:
        found = [message.data for topic, message, _ in bag.read_messages('/bag_a')]
        assert found == [f'/bag_a {number}' for number in range(10)]
        assert bag.get_message_count('/bag_b') == 10


def test_rosbag_plays_to_pharos(node, tmp_path):
    path = tmp_path / 'played.bag'
    with rosbag.Bag(str(path), 'w') as bag:
        for number in range(10):
            bag.write('/played', std_msgs.msg.String(str(number)), genpy.Time(100, number))
    box = Mailbox(node, '/played', STRING)
    # without --keep-alive it ends at once, perhaps before roscpp has sent anything
    options = ['--quiet', '--wait-for-subscribers', '--keep-alive']
    with Program(['rosrun', 'rosbag', 'play', *options, str(path)], node.master.url) as player:
        assert [box.next().data for _ in range(10)] == [str(number) for number in range(10)]
        player.signal(signal.SIGINT)
        player.wait()


# -- roscpp


@needs_relay
@pytest.mark.parametrize('type_', [STRING, IMAGE])
def test_relay_passes_messages_both_ways(master, node, type_):
    source, target = f'/from_{type_[-5:]}', f'/to_{type_[-5:]}'
    channel = node.output_channel(source, type_)
    box = Mailbox(create(master, '/hearer'), target, type_)
    with running(master, RELAY, source, target, '__name:=relay'):
        assert channel.wait_for_subscribers(1, TIMEOUT)
        # relay advertises when the first message comes
        through_relay = [('/relay', 'TCPROS')]
        until(lambda: channel.send() and box.channel.connections == through_relay, TIMEOUT)
        assert channel.connections == through_relay
        for number in range(5):
            data = str(number) if type_ == STRING else bytes([number]) * 1000000
            channel.send(data=data)
            box.wait_for(lambda message, data=data: message.data == data)


@needs_relay
def test_relay_passes_latched_message(master, node):
    node.output_channel('/latched_in', STRING, latch=True).send(data='kept')
    with running(master, RELAY, '/latched_in', '/latched_out'):
        assert Mailbox(create(master, '/late'), '/latched_out', STRING).next().data == 'kept'


@needs_nodelet
def test_service_of_nodelet_manager_is_called(master, node):
    with running(master, NODELET, 'manager', '__name:=manager'):
        listing = node.wait_for_service('/manager/list', TIMEOUT)
        assert listing.type == 'nodelet/NodeletList'
        assert list(listing.call().nodelets) == []


# -- libraries written on rospy


def transform(child):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = 'map'
    message.transform.translation.x, message.transform.rotation.w = 2.0, 1.0
    return message


LOOKED_UP = "buffer.lookup_transform('map', 'here', rospy.Time(0), rospy.Duration(30)).transform"
BROADCASTS = """
import tf2_ros
frame = message_class('geometry_msgs/TransformStamped')()
frame.header.frame_id, frame.child_frame_id = 'map', 'there'
frame.transform.translation.x = frame.transform.rotation.w = 1.0
broadcaster = tf2_ros.StaticTransformBroadcaster()
broadcaster.sendTransform(frame)
"""


def looked_up(node, child):
    """Listen to tf in a node; returns how far the frame is from the map."""
    tf2 = node.ros_import('tf2_ros')
    buffer = tf2.Buffer()
    tf2.TransformListener(buffer)
    found = buffer.lookup_transform('map', child, node.ros.Time(0), node.ros.Duration(TIMEOUT))
    return found.transform.translation.x


def test_transform_reaches_other_node(master, node):
    node.ros_import('tf2_ros').StaticTransformBroadcaster().sendTransform(transform('base'))
    assert looked_up(create(master, '/listener'), 'base') == 2.0


def test_transform_reaches_rospy(peer, node):
    node.ros_import('tf2_ros').StaticTransformBroadcaster().sendTransform(transform('here'))
    peer.run(
        'import tf2_ros\nbuffer = tf2_ros.Buffer()\nlistener = tf2_ros.TransformListener(buffer)'
    )
    assert peer.value(LOOKED_UP).translation.x == 2.0
    peer.run('listener.unregister()')


def test_transform_comes_from_rospy(peer, node):
    peer.run(BROADCASTS)
    assert looked_up(node, 'there') == 1.0


def start_count_server(actionlib_of_node, name):
    """An action server; a client may find it a moment before it knows of the client."""

    def execute(goal):
        server.publish_feedback(actionlib.msg.TestFeedback(feedback=goal.goal))
        server.set_succeeded(actionlib.msg.TestResult(result=goal.goal + 1))

    server = actionlib_of_node.SimpleActionServer(
        name, actionlib.msg.TestAction, execute, auto_start=False
    )
    server.start()
    return server


def test_action_runs_between_two_nodes(master, node):
    server = start_count_server(node.ros_import('actionlib'), '/near')
    asking = create(master, '/asking')
    client = asking.ros_import('actionlib').SimpleActionClient('/near', actionlib.msg.TestAction)
    assert client.wait_for_server(asking.ros.Duration(TIMEOUT))
    until(server.action_server.result_pub.get_num_connections, TIMEOUT)
    client.send_goal_and_wait(actionlib.msg.TestGoal(goal=3), asking.ros.Duration(TIMEOUT))
    assert client.get_result().result == 4


def test_rospy_sends_goal_to_pharos(peer, node):
    server = start_count_server(node.ros_import('actionlib'), '/count')
    peer.run(
        'import actionlib, actionlib.msg\n'
        "client = actionlib.SimpleActionClient('/count', actionlib.msg.TestAction)\n"
        f'assert client.wait_for_server(rospy.Duration({TIMEOUT}))'
    )
    until(server.action_server.result_pub.get_num_connections, TIMEOUT)
    peer.run(
        f'client.send_goal_and_wait(actionlib.msg.TestGoal(goal=3), rospy.Duration({TIMEOUT}))'
    )
    assert peer.value('client.get_result().result') == 4


def test_pharos_sends_goal_to_rospy(peer, node):
    peer.run(
        'import actionlib, actionlib.msg\n'
        'def count(goal): server.set_succeeded(actionlib.msg.TestResult(result=goal.goal + 2))\n'
        "server = actionlib.SimpleActionServer('/remote', actionlib.msg.TestAction, count, False)\n"
        'server.start()'
    )
    library = node.ros_import('actionlib')
    client = library.SimpleActionClient('/remote', actionlib.msg.TestAction)
    assert client.wait_for_server(node.ros.Duration(TIMEOUT))
    until(lambda: peer.value('server.action_server.result_pub.get_num_connections()'), TIMEOUT)
    client.send_goal_and_wait(actionlib.msg.TestGoal(goal=3), node.ros.Duration(TIMEOUT))
    assert client.get_result().result == 5


def test_message_filters_match_equal_times(master, node):
    filters, matched = node.ros_import('message_filters'), Mailbox()
    sides = [filters.Subscriber(topic, PointStamped) for topic in ('/left', '/right')]
    filters.TimeSynchronizer(sides, 10).registerCallback(matched)
    sender = create(master, '/sender')
    for topic, seconds in ('/left', 1), ('/left', 2), ('/right', 2):
        header = std_msgs.msg.Header(stamp=genpy.Time(seconds), frame_id=topic)
        sender.send_to(topic, typed_as='geometry_msgs/PointStamped', header=header)
    left = matched.next()
    assert (left.header.frame_id, left.header.stamp) == ('/left', genpy.Time(2))
