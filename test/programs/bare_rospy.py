"""Try each fault of bare rospy (doc/limits.md), and print what came out as a line of JSON."""
import json
import os
import queue
import socket
import threading
import time
import xmlrpc.client

import rosgraph.network
import rospy
import rospy.impl.tcpros_base
from raw_tcpros import is_without_delay, leave, receive, subscribe
from std_msgs.msg import String
from std_srvs.srv import Empty

threading.Thread.isAlive = threading.Thread.is_alive  # the rospy of Debian 11 calls it at its end

TRIALS = []


def until(condition, limit=20):
    """Wait for something that nobody tells; returns False if it does not come in time."""
    pause = threading.Event()
    for _ in range(limit * 100):
        if condition():
            return True
        pause.wait(0.01)
    return False


def tcp_port():
    return rospy.impl.tcpros_base.get_tcpros_server_address()[1]


def trial(function):
    TRIALS.append(function)
    return function


def busy_port(which):
    """True if the error names a port that is taken; tried in a child, which has no node yet."""
    reading, writing = os.pipe()
    if os.fork() == 0:
        busy = socket.create_server(('127.0.0.1', 0))
        port = busy.getsockname()[1]
        try:
            rospy.init_node('bare_busy', anonymous=True, **{which: port})
            error = ''
        except Exception as raised:
            error = str(raised)
        rospy.signal_shutdown('end')
        os.write(writing, json.dumps(str(port) in error).encode())
        os._exit(0)
    return lambda: json.loads(os.read(reading, 100))


@trial
def second_node():
    try:
        rospy.init_node('second')
        return True
    except rospy.ROSException:
        return False


@trial
def silent_client_blocks_none():
    publisher = rospy.Publisher('/bare/silent', String, queue_size=1)
    silent = socket.create_connection(('127.0.0.1', tcp_port()))
    client = subscribe(tcp_port(), '/bare/silent')
    client.settimeout(0.5)
    try:
        found = bool(client.recv(1, socket.MSG_PEEK))
    except socket.timeout:
        found = False
    silent.close()
    client.settimeout(20)
    receive(client)  # it is served as soon as the other has gone
    publisher.unregister()
    return found


@trial
def first_messages_arrive():
    found = []
    for topic in '/bare/first0', '/bare/first1', '/bare/first2':
        heard = queue.SimpleQueue()
        subscriber = rospy.Subscriber(topic, String, heard.put)
        publisher = rospy.Publisher(topic, String, queue_size=10)
        publisher.publish('first')
        until(lambda: publisher.publish('later') or not heard.empty())
        found.append(heard.get().data == 'first')
        subscriber.unregister()
    return any(found)


@trial
def small_messages_without_delay():
    subscriber = rospy.Subscriber('/bare/small', String)
    publisher = rospy.Publisher('/bare/small', String, queue_size=1)
    until(publisher.get_num_connections)
    found = is_without_delay(publisher.impl.connections[0].socket)
    subscriber.unregister()
    return found


@trial
def latched_by_value():
    heard = queue.SimpleQueue()
    publisher = rospy.Publisher('/bare/latched', String, queue_size=1, latch=True)
    message = String('as it was')
    publisher.publish(message)
    message.data = 'changed since'
    rospy.Subscriber('/bare/latched', String, heard.put)
    return heard.get(timeout=20).data == 'as it was'


@trial
def each_latched_publisher_keeps_its_message():
    heard = []
    for data in 'first', 'second':
        publisher = rospy.Publisher('/bare/latches', String, queue_size=10, latch=True)
        publisher.publish(data)
    rospy.Subscriber('/bare/latches', String, lambda message: heard.append(message.data))
    until(lambda: heard)
    until(lambda: publisher.publish('later') or 'later' in heard)
    return heard[:2] == ['first', 'second']


@trial
def subscriber_that_left_is_known():
    found = []
    publisher = rospy.Publisher('/bare/leaving', String, queue_size=1)
    for number in range(10):
        client = subscribe(tcp_port(), '/bare/leaving', f'/raw{number}')
        until(lambda: publisher.impl.has_connection(f'/raw{number}'))
        leave(client, until)
        found.append(publisher.get_num_connections() == 0)
    return all(found)


@trial
def service_call_takes_a_timeout():
    try:
        rospy.ServiceProxy('/bare/no_service', Empty)(timeout=0.01)
    except rospy.ServiceException:
        return True
    except Exception:
        return False


@trial
def others_are_served_beside_one_that_reads_nothing():
    publisher = rospy.Publisher('/bare/stuck', String)
    clients = [subscribe(tcp_port(), '/bare/stuck', f'/raw{number}') for number in range(2)]
    until(lambda: publisher.get_num_connections() == 2)

    def publish():
        for _ in range(20):
            publisher.publish('x' * 1000000)

    threading.Thread(target=publish, daemon=True).start()
    receive(clients[1])
    clients[1].settimeout(0.5)
    try:
        for _ in range(20):
            receive(clients[1])
        return True
    except socket.timeout:
        return False
    finally:
        for client in clients:
            client.close()


@trial
def one_callback_at_a_time():
    both, found = threading.Barrier(2), queue.SimpleQueue()

    def callback(message):
        try:
            both.wait(20)
            found.put(False)
        except threading.BrokenBarrierError:
            found.put(True)

    for topic in '/bare/left', '/bare/right':
        rospy.Subscriber(topic, String, callback)
        rospy.Publisher(topic, String, queue_size=1, latch=True).publish('go')
    return found.get(timeout=40)


@trial
def subscription_needs_no_type():
    try:
        rospy.Subscriber('/bare/untyped', None, print)
        return True
    except ValueError:
        return False


@trial
def exception_in_a_callback_is_told():
    told, done = [], threading.Event()
    original_hook = threading.excepthook
    threading.excepthook = lambda *arguments: told.append(arguments)

    def callback(message):
        if message.data == 'good':
            done.set()
        raise ValueError(message.data)

    rospy.Subscriber('/bare/raising', String, callback)
    publisher = rospy.Publisher('/bare/raising', String, queue_size=10)
    until(lambda: publisher.publish('bad') or publisher.publish('good') or done.is_set())
    threading.excepthook = original_hook
    return bool(told)


@trial
def one_interface_alone():
    hostname = os.environ.pop('ROS_HOSTNAME')
    bound = rosgraph.network.get_bind_address()
    os.environ['ROS_HOSTNAME'] = hostname
    return bound != '0.0.0.0'


@trial
def shutdown_for_an_earlier_owner_is_ignored():
    """The node is shut down from here on."""
    server = xmlrpc.client.ServerProxy(rospy.get_node_uri())
    server.shutdown('/master', '[/old] Reason: new node registered with same name')
    return not rospy.is_shutdown()


@trial
def no_core_is_busy_after_the_shutdown():
    rospy.signal_shutdown('stop')
    begin = time.process_time() - time.thread_time()
    return not until(lambda: time.process_time() - time.thread_time() > begin + 0.2)


@trial
def starts_again():
    rospy.init_node('bare', anonymous=True)
    return not rospy.is_shutdown()


def main():
    ports = {kind: busy_port(kind) for kind in ('xmlrpc_port', 'tcpros_port')}
    found = {f'busy_{kind}_is_named': answer() for kind, answer in ports.items()}
    rospy.init_node('bare', anonymous=True)
    found.update({function.__name__: function() for function in TRIALS})
    os.write(1, f'\nfound {json.dumps(found)}\n'.encode())
    os._exit(0)


main()
