"""Messages and requests that are filled by a dict, as are those whose fields have the names of
keywords of the calls that send them."""
import pytest
import std_srvs.srv

from helpers import create
import pharos
from pharos import define_message, define_service

TYPE = 'pharos_hidden/Order'
FIELDS = 'topic block typed_as to connect_timeout wait timeout'.split()
CALL_TYPE = 'pharos_hidden/Call'

define_message(TYPE, '\n'.join(f'string {name}' for name in FIELDS) + '\nfloat64 price')
define_service(CALL_TYPE, 'float64 timeout\nstring block\n---\nstring said')


@pytest.fixture
def send(request, master, mailbox):
    """Sends by a node, or by its channel; what arrives is in ``send.mailbox``."""
    create(master, '/receiver', delegate=mailbox).interested_in('/hidden/orders', TYPE)
    node = create(master, '/sender')
    if request.param == 'send_to':

        def send(*args, **fields):
            return node.send_to('/hidden/orders', *args, **fields)

    else:
        channel = node.output_channel('/hidden/orders', TYPE)

        def send(*args, **fields):
            return channel.send(*args, **fields)

    send.mailbox = mailbox
    return send


both = pytest.mark.parametrize('send', ['send_to', 'channel'], indirect=True)


@both
def test_a_dict_fills_all_fields_whatever_their_names(send):
    values = {name: f'the {name}' for name in FIELDS}
    send({**values, 'price': 2}, to='/receiver')
    message = send.mailbox.next()
    assert {name: getattr(message, name) for name in FIELDS} == values
    assert message.price == 2.0


@both
def test_keywords_beside_a_dict_fill_the_message_too(send):
    send({'to': 'kitchen'}, price=3.0)
    message = send.mailbox.next()
    assert (message.to, message.price) == ('kitchen', 3.0)


@both
def test_a_dict_with_a_wrong_field_or_value_is_told_as_keywords_are(send):
    with pytest.raises(pharos.MessageTypeError, match="has no field 'pricy' .did you mean 'price'"):
        send({'pricy': 1})
    with pytest.raises(pharos.MessageTypeError, match="price = 'high' does not fit float64"):
        send({'price': 'high'})
    with pytest.raises(pharos.MessageTypeError, match='has no field 1;'):
        send({1: 1})
    assert send.mailbox.empty()


@both
def test_a_dict_may_hold_others_for_nested_messages(master, mailbox, send):
    node = create(master, '/other', delegate=mailbox)
    node.interested_in('/hidden/moved', 'geometry_msgs/Twist')
    node.send_to('/hidden/moved', {'linear': {'x': 2.0}})
    assert mailbox.next().linear.x == 2.0


def test_a_keyword_that_may_be_meant_for_the_field_is_refused(master, mailbox):
    """It was taken for the call's own, in silence: the message went out without it."""
    create(master, '/receiver', delegate=mailbox).interested_in('/hidden/orders', TYPE)
    node = create(master, '/sender')
    for again in False, True:
        for name, value in ('wait', 0.5), ('connect_timeout', 1.0), ('to', 'the kitchen'):
            with pytest.raises(
                TypeError, match=f"Order has a field '{name}', .* dict, {{'{name}': {value!r}}}"
            ):
                node.send_to('/hidden/orders', price=1.0, **{name: value})
        if not again:
            assert node.channels == []
            node.send_to('/hidden/orders', price=1.0)
    channel = node.output_channel('/hidden/orders')
    with pytest.raises(TypeError, match="has a field 'to', and this call a keyword to="):
        channel.send(to='/receiver', price=1.0)
    with pytest.raises(TypeError, match='multiple values .*topic'):
        node.send_to('/hidden/orders', topic='x')
    with pytest.raises(TypeError, match="a dict of fields, .* 'x' cannot be called"):
        node.send_to('/hidden/orders', block='x')
    assert mailbox.next().price == 1.0
    assert mailbox.empty()


def test_a_block_or_a_ready_message_leaves_no_doubt(master, mailbox):
    create(master, '/receiver', delegate=mailbox).interested_in('/hidden/orders', TYPE)
    node = create(master, '/sender')
    node.send_to(
        '/hidden/orders', lambda message: setattr(message, 'to', 'bar'), to='/receiver', wait=1
    )
    assert mailbox.next().to == 'bar'
    node.send_to(
        '/hidden/orders', pharos.message_class(TYPE)(to='bed'), to='/receiver', connect_timeout=1
    )
    assert mailbox.next().to == 'bed'


def test_a_service_is_called_with_a_dict(master):
    create(master, '/provider').serve(
        '/hidden/order', CALL_TYPE, lambda request: f'{request.timeout} {request.block}'
    )
    service = master.lookup_service('/hidden/order')
    fields = {'timeout': 2.5, 'block': 'b'}
    assert service.call(fields).said == service.call(fields, timeout=10).said == '2.5 b'
    with pytest.raises(TypeError, match=r"CallRequest has a field 'timeout', .* {'timeout': 2.5}"):
        service.call(timeout=2.5)
    with pytest.raises(
        TypeError, match="request is given ready, .* a dict .* 'b' cannot be called"
    ):
        service.call(block='b')


def test_a_service_is_called_with_a_ready_request_as_rospys_proxy(master):
    create(master, '/provider').serve(
        '/set', 'std_srvs/SetBool', lambda request: (request.data, 'done')
    )
    service = master.lookup_service('/set')
    assert service.call(std_srvs.srv.SetBoolRequest(True)).success
    with pytest.raises(TypeError, match='ready std_srvs/SetBoolRequest .* without data'):
        service.call(std_srvs.srv.SetBoolRequest(True), data=False)
    with pytest.raises(
        pharos.MessageTypeError, match=r'/set is called with .*\(data: bool\), not std_srvs/Trigger'
    ):
        service.call(std_srvs.srv.TriggerRequest())
    with pytest.raises(TypeError, match='True cannot be called: .* name.*: data=True'):
        service.call(True)
